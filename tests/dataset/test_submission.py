import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import Log
from nss_ros.dataset.challenge_folder import METADATA_KEY
from nss_ros.dataset.submission import accepted_components, submission
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus, Node, NodeStatus, PoseGraph

IDS = [FragmentId("1", 1 + i // 3, i) for i in range(6)]


def pose_graph(links, rejected=(), unplaced=()):
    """Fragments 0..5 on a line, linked as given."""
    nodes = tuple(
        Node(id_, status=NodeStatus.UNPLACED)
        if i in unplaced
        else Node(id_, from_yaw(0.3 * i, (i, 0, 0)), NodeStatus.PLACED)
        for i, id_ in enumerate(IDS)
    )
    edges = tuple(
        Edge(
            FragmentPair(IDS[s], IDS[t]),
            np.eye(4),
            EdgeKind.SAME_STAGE,
            EdgeStatus.REJECTED if (s, t) in rejected else EdgeStatus.ACCEPTED,
        )
        for s, t in [*links, *rejected]
    )
    return PoseGraph(nodes, edges)


def log_of(graph, templates):
    return Log(Path("log"), pose_graph=graph, metadata={METADATA_KEY: json.dumps(templates)})


def template(name, numbers, edges=None):
    nodes = [[f"n{i}", f"{IDS[i]}.ply"] for i in numbers]
    return {"name": name, "nodes": nodes, "edges": edges}


def test_components_use_accepted_edges_of_the_given_fragments_only():
    graph = pose_graph([(0, 1), (1, 2), (3, 4)], rejected=[(2, 3)], unplaced=[5])
    assert accepted_components(graph, IDS) == [IDS[:3], IDS[3:5]]
    # Without fragment 1, nothing links 0 and 2.
    assert accepted_components(graph, [IDS[0], IDS[2], IDS[3], IDS[4]]) == [IDS[3:5]]
    assert accepted_components(graph, []) == []
    assert accepted_components(pose_graph([]), IDS) == []


def test_each_graph_has_its_own_main_component():
    graph = pose_graph([(0, 1), (1, 2), (3, 4)], unplaced=[5])
    log = log_of(graph, [template("a", range(6), [["n0", "n2", True], ["n3", "n2", None]]),
                         template("b", [4, 3, 0])])  # fmt: skip
    first, second = submission(log)
    assert [node.id for node in first.nodes] == [f"n{i}" for i in range(6)]
    assert [node.outlier for node in first.nodes] == [False] * 3 + [True] * 3
    assert [node.anchor for node in first.nodes] == [True] + [False] * 5
    (edge,) = first.edges
    poses = [node.T_map_fragment for node in graph.nodes]
    np.testing.assert_allclose(edge.transform, relative(poses[0], poses[2]))
    assert edge.same_stage is True
    # A graph without edges that is not wholly placed: all pairs of placed nodes, both ways.
    assert [node.outlier for node in second.nodes] == [False, False, True]
    assert [(e.source, e.target, e.same_stage) for e in second.edges] == [
        ("n4", "n3", True), ("n3", "n4", True)
    ]  # fmt: skip


def test_a_graph_without_edges_that_is_wholly_placed_leaves_them_to_the_poses():
    (graph,) = submission(log_of(pose_graph([(0, 1), (1, 2)]), [template("a", [2, 1, 0])]))
    assert graph.edges is None
    assert not any(node.outlier for node in graph.nodes)


def test_a_graph_of_which_nothing_is_placed():
    (graph,) = submission(log_of(pose_graph([]), [template("a", range(3))]))
    assert all(node.outlier for node in graph.nodes)
    assert graph.edges == ()


def test_fragments_that_never_arrived_are_outliers():
    graph = pose_graph([(0, 1)])
    log = log_of(replace(graph, nodes=graph.nodes[:2]), [template("a", range(3))])
    assert [node.outlier for node in submission(log)[0].nodes] == [False, False, True]


def test_a_log_that_was_not_imported(room):
    truth = room.ground_truth
    log = Log(Path("runs/floor"), pose_graph=truth)
    (whole,) = submission(log)
    assert whole.name == "floor"
    assert [node.name for node in whole.nodes] == [f"{node.id}.ply" for node in truth.nodes]
    (named,) = submission(replace(log, ground_truth=(truth,)))
    assert named.name == "room"
    assert len(named.edges) == len(truth.edges)


def test_what_cannot_be_exported_says_so():
    with pytest.raises(InputError, match="no pose graph"):
        submission(Log(Path("log")))
    for damaged in ("{", "[3]", '[{"name": "a"}]'):
        log = Log(Path("log"), pose_graph=pose_graph([]), metadata={METADATA_KEY: damaged})
        with pytest.raises(FormatError, match="metadata 'challenge' of log is damaged"):
            submission(log)
