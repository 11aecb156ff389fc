from dataclasses import replace

import numpy as np
import pytest

from nss_ros.benchmark.overlap_truth import COMPLETE_KEY, OverlapClouds, OverlapTruth
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw
from nss_ros.multiway.pose_graph import Node


def turned(pair):
    return FragmentPair(pair.target, pair.source)


@pytest.fixture
def log(make_run):
    """Of the room, whose first pair has no edge and whose second an edge without a ratio."""
    log = make_run()
    truth = log.ground_truth[0]
    edges = (replace(truth.edges[1], overlap_ratio=float("nan")), *truth.edges[2:])
    return replace(log, ground_truth=(replace(truth, edges=edges),))


def truth_of(log, *pairs):
    clouds = OverlapClouds(log.fragments)
    return OverlapTruth(log, log.ground_truth, clouds).overlaps(pairs).tolist()


def test_an_edge_decides_in_either_direction(log):
    edge = replace(log.ground_truth[0].edges[1], overlap_ratio=0.1)
    below = replace(log.ground_truth[0].edges[2], overlap_ratio=0.0999)
    graph = replace(log.ground_truth[0], edges=(edge, below))
    pairs = edge.pair, turned(edge.pair), below.pair, turned(below.pair)
    assert truth_of(replace(log, ground_truth=(graph,)), *pairs) == [1, 1, 0, 0]


def test_point_clouds_decide_where_no_edge_does(log):
    pairs = log.pairs[0], log.pairs[1]
    assert truth_of(log, *pairs) == [1, 1]
    truth = log.ground_truth[0]
    far = from_yaw(0, (100, 0, 0))
    nodes = tuple(
        replace(node, T_map_fragment=far) if node.id == log.pairs[0].source else node
        for node in truth.nodes
    )
    moved = replace(log, ground_truth=(replace(truth, nodes=nodes),))
    assert truth_of(moved, log.pairs[0]) == [0]


def test_without_points_a_missing_edge_tells_only_of_a_complete_graph(log):
    bare = replace(log, fragments={})
    pairs = log.pairs[0], turned(log.pairs[0]), log.pairs[1]
    assert np.isnan(truth_of(bare, *pairs)).all()
    for limit in ("0.3", "many"):
        assert np.isnan(truth_of(replace(bare, metadata={COMPLETE_KEY: limit}), *pairs)).all()
    complete = truth_of(replace(bare, metadata={COMPLETE_KEY: "0.1"}), *pairs)
    assert complete[:2] == [0, 0]
    assert np.isnan(complete[2])


def test_other_areas_do_not_overlap_and_hidden_poses_tell_nothing(log):
    pair = log.pairs[0]
    elsewhere = replace(pair, source=FragmentId("2", 1, 0))
    nodes = tuple(
        Node(node.id) if node.id == pair.source else node for node in log.ground_truth[0].nodes
    )
    hidden = replace(log, ground_truth=(replace(log.ground_truth[0], nodes=nodes),))
    result = truth_of(hidden, elsewhere, pair)
    assert result[0] == 0
    assert np.isnan(result[1])
