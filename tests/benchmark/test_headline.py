from dataclasses import replace

import numpy as np
import pytest

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.benchmark.headline import FIGURES, headline
from nss_ros.benchmark.score import score_log
from nss_ros.multiway.pose_graph import EdgeKind, Node, NodeStatus

NONE = Bootstrap(0)


@pytest.fixture
def score(make_run):
    return score_log(make_run(wrong=(1, 7, 9), noise=0.05))


def test_headline_figures_are_those_of_the_score(score):
    figures = score.headline
    for prefix, subsets in (("", score.overall.pairwise), ("multiway_", score.overall.multiway)):
        for kind in ("all", "same_stage", "different_stage"):
            for name in ("recall", "recall_challenge", "rte", "rre", "rte_answered", "rmse"):
                expected = getattr(getattr(subsets, kind), name)
                assert figures[f"{prefix}{name}_{kind}"].value == pytest.approx(expected)
    for name in ("global_rmse", "official_global_rmse", "coverage", "outlier_f1"):
        assert figures[name].value == pytest.approx(getattr(score.overall.map, name))
    overlap, confidence = score.overlap.all, score.calibration.all
    assert figures["overlap_auroc"].value == pytest.approx(overlap.auroc)
    assert figures["overlap_mean_average_precision"].value == pytest.approx(
        overlap.mean_average_precision
    )
    assert figures["overlap_average_precision"].value == pytest.approx(overlap.average_precision)
    by_map = score.map_overlap.all
    assert figures["map_overlap_auroc"].value == pytest.approx(by_map.auroc)
    assert figures["map_overlap_mean_average_precision"].value == pytest.approx(
        by_map.mean_average_precision
    )
    assert figures["confidence_error"].value == pytest.approx(confidence.expected_error)
    assert figures["confidence_auroc"].value == pytest.approx(confidence.auroc)


def test_every_figure_has_an_interval_around_it(score):
    assert list(score.headline) == list(FIGURES)
    for figure in score.headline.values():
        assert figure.low <= figure.value + 1e-9
        assert figure.high >= figure.value - 1e-9
    assert score.headline["recall_all"].low < 80 < score.headline["recall_all"].high


def test_the_same_seed_gives_the_same_intervals(make_run):
    evaluation = evaluate(make_run(wrong=(1, 2)))
    assert headline(evaluation, Bootstrap(50)) == headline(evaluation, Bootstrap(50))
    other = headline(evaluation, Bootstrap(50, seed=1))
    assert other["rte_all"] != headline(evaluation, Bootstrap(50))["rte_all"]
    assert np.isnan(headline(evaluation, NONE)["rte_all"].low)


def test_one_edge_has_figures_but_no_interval(make_run):
    log = make_run()
    graph = replace(log.ground_truth[0], edges=log.ground_truth[0].edges[:1])
    score = score_log(replace(log, ground_truth=(graph,), pairs=log.pairs[:1]))
    recall = score.headline["recall_all"]
    assert recall.value == 100
    assert np.isnan([recall.low, recall.high]).all()
    assert np.isnan(score.headline["recall_different_stage"].value)


def test_no_different_stage_edges_no_map_no_points_no_probabilities(make_run):
    log = make_run()
    truth = log.ground_truth[0]
    same = tuple(edge for edge in truth.edges if edge.kind is EdgeKind.SAME_STAGE)
    answers = {
        pair: replace(answer, overlap_probability=float("nan"), confidence=float("nan"))
        for pair, answer in log.relative_transforms.items()
    }
    score = score_log(
        replace(log, ground_truth=(replace(truth, edges=same),), relative_transforms=answers,
                fragments={}, pose_graph=None)
    )  # fmt: skip
    assert np.isnan(score.headline["recall_different_stage"].value)
    assert np.isnan(score.headline["recall_different_stage"].low)
    assert score.headline["recall_same_stage"].value == 100
    assert np.isnan(score.headline["rmse_all"].value)
    assert score.overlap.all is score.calibration.all is None
    assert score.overlap.without_probability == 15
    assert not {"global_rmse", "multiway_recall_all", "overlap_auroc"} & score.headline.keys()
    assert score.displacements == ()


def test_a_graph_without_edges_has_only_the_figures_of_the_map(make_run):
    log = make_run(relative_transforms={}, pairs=())
    graph = replace(log.ground_truth[0], edges=())
    figures = score_log(replace(log, ground_truth=(graph,))).headline
    assert figures["global_rmse"].value > 0
    assert "recall_all" not in figures


def test_outliers_are_resampled_too(make_run):
    log = make_run()
    truth = log.ground_truth[0]
    gone = truth.nodes[0].id
    nodes = (Node(gone, status=NodeStatus.OUTLIER), *truth.nodes[1:])
    edges = tuple(e for e in truth.edges if gone not in (e.pair.source, e.pair.target))
    score = score_log(replace(log, ground_truth=(replace(truth, nodes=nodes, edges=edges),)))
    assert score.overall.map.outlier_f1 == score.headline["outlier_f1"].value == 0
    assert score.overall.map.official_global_rmse == pytest.approx(
        score.headline["official_global_rmse"].value
    )


def test_bins_hold_every_edge_once(score, make_run):
    for bins in (score.overlap_bins, score.change_bins):
        assert sum(each.edges["all"] for each in bins) == 15
        for each in bins:
            assert each.edges["all"] == each.edges["same_stage"] + each.edges["different_stage"]
            assert each.multiway is not None
    hits = sum(each.pairwise["all"] * each.edges["all"] for each in score.overlap_bins)
    assert hits / 15 == pytest.approx(score.overall.pairwise.all.recall)
    log = make_run()
    ratios = [0.0, 0.1, 0.3, 0.6, 0.7, 0.9, 1.0, float("nan")] * 2
    edges = tuple(
        replace(edge, overlap_ratio=ratio)
        for edge, ratio in zip(log.ground_truth[0].edges, ratios, strict=False)
    )
    graph = replace(log.ground_truth[0], edges=edges)
    bins = score_log(replace(log, ground_truth=(graph,)), NONE).overlap_bins
    assert [each.low for each in bins] == [0, 0.1, 0.3, 0.6, 0.7, 0.9]
    assert [each.edges["all"] for each in bins] == [2, 2, 2, 2, 2, 4]
