from dataclasses import fields, replace

import numpy as np
import pytest

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import evaluate, joined, relatives, rows
from nss_ros.benchmark.score import summarize
from nss_ros.benchmark.table import overlap_table
from nss_ros.dataset.overlap import Cloud, pair_overlap
from nss_ros.geometry import exponential, relative
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.registration.relative_transform import Reason, failed

NONE = Bootstrap(0)


def test_relative_transforms_of_many_are_those_of_each():
    rng = np.random.default_rng(0)
    poses = np.stack([exponential(rng.normal(size=6)) for _ in range(8)])
    expected = [relative(a, b) for a, b in zip(poses[:4], poses[4:], strict=True)]
    assert relatives(poses[:4], poses[4:]) == pytest.approx(np.stack(expected))


def test_two_logs_as_one_result_set(make_run):
    part = evaluate(make_run("a"))
    other = evaluate(make_run("b", wrong=(0, 1, 2), seed=1))
    both = summarize(joined([part, other]), NONE)
    one, two = summarize(part, NONE), summarize(other, NONE)
    assert both.pairs == 30
    assert [graph.name for graph in both.graphs] == ["room", "room"]
    assert replace(both.graphs[0]) == one.graphs[0]
    assert both.graphs[1] == two.graphs[0]
    edges = both.overall.pairwise.all
    assert edges.edges == 30
    assert edges.recall == pytest.approx(100 * 27 / 30)
    squares = [each.overall.map.global_rmse**2 for each in (one, two)]
    assert both.overall.map.global_rmse == pytest.approx(np.sqrt(np.mean(squares)))
    assert both.method == "test"


def test_a_log_without_a_map_leaves_the_result_set_without(make_run):
    both = joined([evaluate(make_run("a")), evaluate(make_run("b", pose_graph=None))])
    assert both.placements is None
    assert both.edges.multiway is None
    assert len(both.edges.pairs) == 30


def test_rows_keep_columns_together(make_run):
    edges = evaluate(make_run(wrong=(3,))).edges
    some = rows(edges, np.array([4, 3]))
    assert some.pairs == (edges.pairs[4], edges.pairs[3])
    assert some.pairwise.rte.tolist() == edges.pairwise.rte[[4, 3]].tolist()
    assert len(rows(edges, np.zeros(15, dtype=bool)).pairs) == 0
    assert {len(getattr(some, field.name)) for field in fields(some)[:-2]} == {2}


def test_answers_of_pairs_that_are_no_edge_are_judged_by_poses(make_run):
    log = make_run()
    graph = replace(log.ground_truth[0], edges=log.ground_truth[0].edges[5:])
    answers = dict(log.relative_transforms)
    answers[log.pairs[1]] = failed(log.pairs[1], "test", Reason.TOO_FEW_INLIERS, "")
    result = evaluate(replace(log, ground_truth=(graph,), relative_transforms=answers)).answers
    assert result.rte[0] < 0.2
    assert not result.ok[1]
    assert np.isnan([result.rte[1], result.confidence[1], result.overlap[1]]).all()


def test_overlap_by_the_map_is_that_of_its_poses(make_run, cut):
    log = cut(make_run(), 4, 6)
    answers = evaluate(log).answers
    nodes, numbers = log.pose_graph.poses(), {0: 0, 1: 0}
    for pair, overlap in zip(answers.pairs, answers.map_overlap, strict=True):
        source, target = nodes[pair.source], nodes[pair.target]
        expected = 0.0
        if source.component == target.component:
            numbers[source.component] += 1
            transform = relative(source.T_map_fragment, target.T_map_fragment)
            clouds = (Cloud(log.fragments[id_].points) for id_ in (pair.source, pair.target))
            expected = pair_overlap(*clouds, transform).overlap_ratio
            assert expected > 0.1
        assert overlap == pytest.approx(expected)
    assert numbers == {0: 6, 1: 1}
    score = summarize(evaluate(log), NONE)
    judged = score.map_overlap.all
    # The first edge alone is below the limit.
    assert (judged.pairs, judged.overlapping) == (15, 14)
    assert judged.recall == pytest.approx(np.mean(answers.map_overlap[1:] >= 0.1))
    table = overlap_table([score])
    assert [row[0] for row in table.rows] == ["pair"] * 3 + ["map"] * 3
    assert "By map" in table.caption


@pytest.mark.parametrize("missing", [{"fragments": {}}, {"pose_graph": None}])
def test_without_a_map_or_points_the_map_tells_no_overlap(make_run, missing):
    evaluation = evaluate(make_run(**missing))
    assert np.isnan(evaluation.answers.map_overlap).all()
    score = summarize(evaluation, NONE)
    assert score.map_overlap.all is None
    assert "by" not in [column.heading for column in overlap_table([score]).columns]


def test_a_graph_that_reaches_into_another_area(make_run):
    log = make_run()
    node = log.ground_truth[0].nodes[-1]
    moved = replace(node, id=replace(node.id, area="2"))
    graph = PoseGraph((*log.ground_truth[0].nodes, moved), log.ground_truth[0].edges, "two")
    score = summarize(evaluate(replace(log, ground_truth=(graph,))), NONE)
    (area,) = score.areas
    assert (area.name, area.map) == ("1", None)
    assert area.pairwise == score.overall.pairwise
