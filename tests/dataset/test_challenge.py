import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nss_ros.dataset.challenge import (
    ChallengeEdge,
    ChallengeGraph,
    ChallengeNode,
    all_pairs,
    edge_pairs,
    fragment_ids,
    ground_truth,
    read_graphs,
    write_graph,
    write_graphs,
)
from nss_ros.errors import FormatError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import exponential, from_yaw, relative
from nss_ros.multiway.pose_graph import EdgeKind, NodeStatus

EYE = np.eye(4).tolist()
ZERO = np.zeros((4, 4)).tolist()


def graph_2025() -> dict:
    return {
        "name": "Bldg1_Graph3",
        "size": 3,
        "nodes": [
            {"id": 0, "name": "Bldg1_Stage3_Spot495.ply", "building": 1, "stage": 3, "spot": 495,
             "points": 10, "global_transform": EYE},
            {"id": 7, "name": "Bldg1_Stage4_Spot2.ply", "building": "1", "stage": "4",
             "spot": "2", "global_transform": from_yaw(1.0, (1, 2, 3)).tolist()},
            {"id": "c", "name": "Bldg1_Stage4_Spot3.ply", "global_transform": ZERO},
        ],
        "edges": [
            {"source_id": 7, "target_id": 0,
             "relative_transform": from_yaw(1.0, (1, 2, 3)).tolist(),
             "overlap_ratio": 0.618, "temporal_change": 0.25, "same_stage": False}
        ],
    }  # fmt: skip


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_both_years_give_the_same_graph(tmp_path):
    new = write(tmp_path / "graph.json", graph_2025())
    text = new.read_text()
    for name, old in (("global_transform", "tsfm"), ("relative_transform", "tsfm"),
                      ("source_id", "source"), ("target_id", "target"),
                      ("overlap_ratio", "overlap")):  # fmt: skip
        text = text.replace(f'"{name}"', f'"{old}"')
    truths = [ground_truth(*read_graphs(new))]
    truths.append(ground_truth(*read_graphs(write(tmp_path / "graph.json", f"[{text}]"))))
    for truth in truths:
        assert [node.status for node in truth.nodes] == [
            NodeStatus.PLACED, NodeStatus.PLACED, NodeStatus.OUTLIER
        ]  # fmt: skip
        (edge,) = truth.edges
        assert edge.pair.source == FragmentId("1", 4, 2)
        assert edge.kind is EdgeKind.DIFFERENT_STAGE
        assert (edge.overlap_ratio, edge.temporal_change) == (0.618, 0.25)
        np.testing.assert_allclose(edge.T_target_source, from_yaw(1.0, (1, 2, 3)), atol=1e-12)


def test_a_hidden_graph_has_no_poses_and_all_pairs(tmp_path):
    content = graph_2025()
    del content["edges"]
    for node in content["nodes"]:
        del node["global_transform"]
    (graph,) = read_graphs(write(tmp_path / "graph.json", content))
    truth = ground_truth(graph)
    assert {node.status for node in truth.nodes} == {NodeStatus.UNPLACED}
    assert truth.edges == ()
    assert edge_pairs(graph) == []
    assert [str(pair) for pair in all_pairs(graph)] == [
        "Bldg1_Stage3_Spot495 -> Bldg1_Stage4_Spot2",
        "Bldg1_Stage3_Spot495 -> Bldg1_Stage4_Spot3",
        "Bldg1_Stage4_Spot2 -> Bldg1_Stage4_Spot3",
    ]


def test_an_edge_without_transform_gets_that_of_the_poses(tmp_path):
    content = graph_2025()
    content["edges"][0]["relative_transform"] = None
    content["edges"].append({"source_id": "c", "target_id": 0})
    (graph,) = read_graphs(write(tmp_path / "graph.json", content))
    (edge,) = ground_truth(graph).edges
    np.testing.assert_allclose(edge.T_target_source, from_yaw(1.0, (1, 2, 3)), atol=1e-12)


def test_names_default_to_the_file(tmp_path):
    content = graph_2025()
    del content["name"]
    path = write(tmp_path / "floor.json", [content, content])
    assert [graph.name for graph in read_graphs(path)] == ["floor_0", "floor_1"]
    assert read_graphs(write(path, content))[0].name == "floor"


@given(arrays(np.float64, 6, elements=st.floats(-3, 3)), st.sampled_from([0, 17, "0", "x"]))
def test_written_graphs_are_read_back_exactly(tmp_path_factory, twist, node_id):
    path = tmp_path_factory.mktemp("graphs") / "graphs.json"
    pose = exponential(twist)
    graph = ChallengeGraph(
        "Bldg1_Graph1",
        (
            ChallengeNode(node_id, "Bldg1_Stage1_Spot1.ply", pose, anchor=True),
            ChallengeNode(1, "Bldg1_Stage1_Spot2.ply", np.zeros((4, 4))),
        ),
        (ChallengeEdge(node_id, 1, pose, same_stage=True),),
    )
    write_graphs(path, [graph, replace(graph, edges=None)])
    first, second = read_graphs(path)
    assert [node.id for node in first.nodes] == [node_id, 1]
    assert first.nodes[0].anchor
    assert first.nodes[1].outlier
    np.testing.assert_array_equal(first.nodes[0].transform, pose)
    np.testing.assert_array_equal(first.edges[0].transform, pose)
    assert first.edges[0].same_stage is True
    assert second.edges is None


def test_a_graph_of_the_release_is_written_as_it_was_read(tmp_path):
    content = graph_2025()
    content["nodes"][1] |= {"building": 1, "stage": 4, "spot": 2}  # numbers, as the release does
    (graph,) = read_graphs(write(tmp_path / "graph.json", content))
    assert graph.nodes[0].points == 10
    assert graph.nodes[1].points is None
    write_graph(tmp_path / "again.json", graph)
    assert json.loads((tmp_path / "again.json").read_text()) == content


def test_a_building_with_a_name_keeps_it(tmp_path):
    names = ("B2", "007", "7")
    nodes = tuple(
        ChallengeNode(i, f"Bldg{name}_Stage1_Spot1.ply", labels=(("building", name),))
        for i, name in enumerate(names)
    )
    write_graph(tmp_path / "graph.json", ChallengeGraph("g", nodes))
    written = json.loads((tmp_path / "graph.json").read_text())
    assert [node["building"] for node in written["nodes"]] == ["B2", "007", 7]
    (graph,) = read_graphs(tmp_path / "graph.json")
    assert [id_.area for id_ in fragment_ids(graph).values()] == list(names)


def changed(*changes):
    content = graph_2025()
    for path, value in changes:
        place = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
    return content


LONG = (np.eye(4) * 1.5).tolist()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("3", "not a pose graph"),
        ({"scores": {}}, "not a pose graph"),
        (changed((("edges",), 5)), "'edges' of graph Bldg1_Graph3 .* must be a list"),
        (changed((("nodes", 1), 5)), "A node of .* is not an object"),
        (changed((("nodes", 1, "id"), 0)), "Node id 0 occurs twice"),
        (changed((("nodes", 1, "id"), None)), "needs a number or a text as 'id'"),
        (changed((("nodes", 1, "global_transform"), [[10**400] * 4] * 4)), "not a 4x4 matrix"),
        (changed((("nodes", 1, "id"), True)), "needs a number or a text as 'id'"),
        (
            changed((("nodes", 2, "name"), "Bldg1_Stage4_Spot2.ply")),
            "Nodes 7 and 'c' .* same name Bldg1_Stage4_Spot2.ply",
        ),
        (changed((("nodes", 0, "name"), "scan.ply")), "'scan.ply' is not a fragment id"),
        (changed((("nodes", 0, "name"), None)), "Node 0 .* has no name"),
        (changed((("nodes", 0, "name"), 3)), "name of node 0 .* is not a text"),
        (changed((("nodes", 0, "points"), -1)), "'points' of node 0 .* not a count: -1"),
        (changed((("nodes", 0, "points"), "many")), "'points' of node 0 .* not a count"),
        (changed((("nodes", 0, "stage"), 2)), "its stage is 2: make them agree"),
        (changed((("nodes", 0, "building"), "B")), "its building is B"),
        (changed((("nodes", 0, "global_transform"), LONG)), "pose of node 0 .* is not rigid"),
        (changed((("nodes", 0, "global_transform"), [1, 2])), "not a 4x4 matrix"),
        (changed((("nodes", 0, "global_transform"), "eye")), "not a 4x4 matrix"),
        (changed((("edges", 0), [])), "An edge of .* is not an object"),
        (changed((("edges", 0, "source_id"), None)), "An edge of .* as 'source_id'"),
        (changed((("edges", 0, "source_id"), 99)), "names the node 99"),
        (changed((("edges", 0, "source_id"), 0)), "links node 0 to itself"),
        (changed((("edges", 0, "relative_transform"), ZERO)), "edge 7 -> 0 .* is not rigid"),
        (changed((("edges", 0, "relative_transform"), LONG)), "edge 7 -> 0 .* is not rigid"),
        (changed((("edges", 0, "same_stage"), "yes")), "must be true or false"),
        (changed((("edges", 0, "overlap_ratio"), "half")), "ratio of edge 7 -> 0 .* not a number"),
    ],
)  # fmt: skip
def test_what_is_not_valid_is_named(tmp_path, content, words):
    path = write(tmp_path / "graph.json", content)
    with pytest.raises(FormatError, match=words) as caught:
        ground_truth(*read_graphs(path))
    assert str(path) in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(FormatError, match="Cannot read pose graphs"):
        read_graphs(tmp_path / "none.json")


def test_float_noise_in_a_rotation_is_accepted(tmp_path):
    noisy = exponential([1, 2, 3, 0.1, 0.2, 0.3])
    noisy[:3, :3] += np.random.default_rng(0).normal(scale=1e-7, size=(3, 3))
    content = changed((("nodes", 1, "global_transform"), noisy.tolist()))
    (graph,) = read_graphs(write(tmp_path / "graph.json", content))
    np.testing.assert_array_equal(graph.nodes[1].transform, noisy)
    pose = ground_truth(graph).nodes[1].T_map_fragment
    np.testing.assert_allclose(pose, noisy, atol=1e-6)
    np.testing.assert_allclose(relative(pose, pose), np.eye(4), atol=1e-12)
