from dataclasses import replace

import numpy as np
import pytest

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.comparison import compare
from nss_ros.benchmark.comparison_table import comparison_tables
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.errors import InputError
from nss_ros.geometry import exponential

FEW = Bootstrap(400)


def compared(first, second, bootstrap=FEW):
    return compare(evaluate(first), evaluate(second), bootstrap)


def test_a_run_against_itself(make_run):
    log = make_run(wrong=(1, 2), noise=0.05)
    result = compared(log, log)
    assert (result.edges, result.fragments, result.notes) == (15, 6, ())
    for each in result.differences.values():
        assert each.difference == each.low == each.high == 0
        assert each.p_value == 1
        assert each.better is None
    assert result.pairwise.won == result.pairwise.lost == ()
    assert result.multiway.won == result.multiway.lost == ()


def test_a_better_run_wins_and_the_other_way_round(make_run):
    worse = make_run("a", wrong=(0, 1, 2, 3, 4, 5, 6, 7), noise=0.02)
    better = make_run("b", wrong=(7,), noise=0.01, seed=1)
    result, turned = compared(worse, better), compared(better, worse)
    assert result.pairwise.won == turned.pairwise.lost == better.pairs[:7]
    assert result.pairwise.lost == turned.pairwise.won == ()
    recall = result.differences["recall_all"]
    assert recall.difference == pytest.approx(100 * 7 / 15)
    assert recall.better is True
    assert recall.p_value < 0.05
    assert turned.differences["recall_all"].better is False
    assert turned.differences["rte_answered_all"].better is False  # smaller is better
    for name, each in result.differences.items():
        assert turned.differences[name].difference == pytest.approx(-each.difference, nan_ok=True)
        assert turned.differences[name].p_value == each.p_value or np.isnan(each.p_value)


def test_resamplings_are_paired(make_run):
    """What is hard for both cancels out: a constant gain is certain, however wide the errors."""
    first = make_run("a", noise=0.0)
    rng = np.random.default_rng(0)
    answers, better = {}, {}
    for pair, answer in first.relative_transforms.items():
        T = answer.T_target_source.copy()
        T[0, 3] += rng.uniform(0.05, 0.15)
        answers[pair] = replace(answer, T_target_source=T)
        better[pair] = replace(answer, T_target_source=T - np.eye(4)[0][:, None] * [0, 0, 0, 0.01])
    result = compared(
        replace(first, relative_transforms=answers), replace(first, relative_transforms=better)
    )
    rte = result.differences["rte_all"]
    assert rte.low == pytest.approx(-0.01)
    assert rte.high == pytest.approx(-0.01)


def test_only_what_both_were_asked_for_counts(make_run):
    whole = make_run("a")
    part = make_run("b")
    answers = {pair: part.relative_transforms[pair] for pair in part.pairs[:10]}
    result = compared(whole, replace(part, pairs=part.pairs[:10], relative_transforms=answers))
    assert result.edges == 10
    assert any("one log was not asked" in note for note in result.notes)
    partial = replace(part, relative_transforms=answers)
    result = compared(whole, partial)
    assert result.edges == 15
    assert result.differences["recall_all"].value == pytest.approx(100 * 10 / 15)
    assert result.pairwise.lost == part.pairs[10:]
    assert any("5 of 15 pairs have no answer" in note for note in result.notes)


def test_edges_of_one_log_only_are_told(make_run):
    log = make_run("a")
    graph = replace(log.ground_truth[0], edges=log.ground_truth[0].edges[3:])
    result = compared(log, replace(log, ground_truth=(graph,)))
    assert result.edges == 12
    assert "3 edges are in the ground truth of one log only." in result.notes


def test_logs_without_common_ground_truth_are_refused(make_run):
    log = make_run("a")
    truth = log.ground_truth[0]
    other = replace(log, ground_truth=(replace(truth, name="elsewhere"),))
    with pytest.raises(InputError, match="no ground-truth edge in common"):
        compared(log, other)
    edges = tuple(
        replace(e, T_target_source=exponential((0.1, 0, 0, 0, 0, 0)) @ e.T_target_source)
        for e in truth.edges
    )
    with pytest.raises(InputError, match="their ground truth differs"):
        compared(log, replace(log, ground_truth=(replace(truth, edges=edges),)))
    halves = [
        replace(
            log, pairs=pairs, relative_transforms={p: log.relative_transforms[p] for p in pairs}
        )
        for pairs in (log.pairs[:5], log.pairs[5:])
    ]
    with pytest.raises(InputError, match="asked for different pairs"):
        compared(*halves)


def test_a_log_that_holds_only_a_map_is_compared_by_its_map(make_run):
    log = make_run("a")
    bare = replace(log, pairs=(), relative_transforms={})
    result = compared(log, bare)
    assert result.edges == 15
    assert result.differences["multiway_recall_all"].difference == 0
    assert compared(log, replace(log, pose_graph=None)).multiway is None


def test_bins_add_up(make_run):
    result = compared(make_run("a", wrong=(0, 1)), make_run("b", wrong=(14,)))
    for bins in (result.overlap_bins, result.change_bins):
        assert sum(each.edges["all"] for each in bins) == 15
        gains = [(e.value["all"] - e.baseline["all"]) * e.edges["all"] for e in bins]
        assert sum(gains) == pytest.approx(100)
    assert "p" in comparison_tables(result)["overlap_bins"].to_csv()


def test_without_resamplings_and_by_fragment(make_run):
    logs = make_run("a", wrong=(0,)), make_run("b", noise=0.03)
    plain = compared(*logs, Bootstrap(0)).differences["recall_all"]
    assert plain.difference == pytest.approx(100 / 15)
    assert np.isnan([plain.low, plain.p_value]).all()
    wide = compared(*logs, Bootstrap(400, by_fragment=True)).differences["recall_all"]
    assert wide.difference == plain.difference
    assert wide.low <= plain.difference <= wide.high
