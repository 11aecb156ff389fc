"""The synchronizer with the weights of the package and with others."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from nss_ros.config import MultiwayConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, inverse, relative, rotation_angle
from nss_ros.multiway.pose_graph import EdgeStatus, Measurement, NodeStatus
from nss_ros.multiway.posegraphnet.method import PoseGraphNet
from nss_ros.multiway.posegraphnet.network import SynchronizationNetwork
from nss_ros.multiway.posegraphnet.simulated_graph import GraphSettings, simulated_graph
from nss_ros.multiway.posegraphnet.start import tree_poses
from nss_ros.multiway.posegraphnet.weights import Usage, load_weights, save_weights

EXACT = GraphSettings(
    fragments=(20, 40),
    stages=(2, 3),
    degree=(5, 8),
    right_within=(1, 1),
    right_across=(1, 1),
    noise_translation=(1e-9, 1e-9),
    noise_rotation=(1e-9, 1e-9),
)
FEW = replace(
    EXACT,
    right_within=(0.85, 0.85),
    right_across=(0.85, 0.85),
    aliased=(0, 0),
    noise_translation=(0.03, 0.03),
    noise_rotation=(0.5, 0.5),
)
RANDOM = replace(GraphSettings(), aliased=(0, 0), right_within=(0.6, 0.6), right_across=(0.5, 0.5))


def graph_of(seed, settings=RANDOM):
    # Training draws from seeds that begin with 0.
    return simulated_graph(np.random.default_rng((1, 77, seed)), settings)


@pytest.fixture(scope="module")
def method():
    return PoseGraphNet(MultiwayConfig())


def solve(method, graph):
    return method.synchronize(graph.fragments, graph.measurements)


def errors(graph, poses):
    """Metres and degrees of the pairs of a graph by poses (T_map_fragment by id)."""
    found = []
    for pair in (m.pair for m in graph.measurements):
        truth = relative(graph.poses[pair.source], graph.poses[pair.target])
        transform = relative(poses[pair.source], poses[pair.target])
        found.append(
            (
                np.linalg.norm((transform - truth)[:3, 3]),
                np.degrees(rotation_angle(relative(transform, truth))),
            )
        )
    return np.array(found)


def recall(graph, poses):
    shifts, turns = errors(graph, poses).T
    return np.mean((shifts < 0.2) & (turns < 10))


def placed(graph):
    return {node.id: node.T_map_fragment for node in graph.nodes if node.component == 0}


def fingerprint(graph):
    nodes = [(n.id, n.status, n.component, n.T_map_fragment.tobytes()) for n in graph.nodes]
    edges = [(e.pair, e.status, e.reason, repr(e.residual_translation)) for e in graph.edges]
    return nodes, edges


@pytest.mark.parametrize("seed", range(4))
def test_graphs_without_noise_are_nearly_exact(method, seed):
    """The network moves poses that are right already, by the bound that is tested here."""
    graph = graph_of(seed, EXACT)
    result = solve(method, graph)
    assert {node.status for node in result.nodes} == {NodeStatus.PLACED}
    assert {edge.status for edge in result.edges} == {EdgeStatus.ACCEPTED}
    shifts, turns = errors(graph, placed(result)).T
    assert shifts.max() < 0.1
    assert turns.max() < 0.5


def test_random_outliers_are_undone_better_than_by_a_spanning_tree(method):
    better = []
    for seed in range(6):
        graph = graph_of(seed)
        start = tree_poses(graph.fragments, graph.measurements, method.close)
        found = method.poses(graph.fragments, graph.measurements)
        better.append((recall(graph, start), recall(graph, found)))
    tree, network = np.mean(better, axis=0)
    assert network > tree + 0.1


def test_edges_that_contradict_the_poses_are_rejected(method):
    graph = graph_of(0, FEW)
    assert 0.1 < np.mean(~graph.right) < 0.25
    result = solve(method, graph)
    poses = result.poses()
    for edge in result.edges:
        one, other = poses.get(edge.pair.source), poses.get(edge.pair.target)
        if one is None or other is None or one.component != other.component:
            assert edge.status is EdgeStatus.REJECTED
            assert np.isnan(edge.residual_translation)
            continue
        far = edge.residual_translation > 0.4 or edge.residual_rotation > np.radians(6)
        assert (edge.status is EdgeStatus.REJECTED) == far
        assert (edge.reason != "") == far
    statuses = np.array([edge.status is EdgeStatus.ACCEPTED for edge in result.edges])
    assert [edge.pair for edge in result.edges] == [m.pair for m in graph.measurements]
    assert np.mean(statuses == graph.right) > 0.95


def test_the_order_of_the_arguments_changes_nothing(method):
    graph = graph_of(2)
    rng = np.random.default_rng(0)
    expected = fingerprint(solve(method, graph))
    shuffled = [graph.measurements[i] for i in rng.permutation(len(graph.measurements))]
    ids = [graph.fragments[i] for i in rng.permutation(len(graph.fragments))]
    assert fingerprint(method.synchronize(ids, shuffled)) == expected
    assert fingerprint(PoseGraphNet(MultiwayConfig()).synchronize(ids, shuffled)) == expected


def test_other_names_give_the_same_poses(method):
    graph = graph_of(0, EXACT)
    numbers = np.random.default_rng(1).permutation(len(graph.fragments))
    names = {
        id_: FragmentId("9", id_.stage, int(number) + 1)
        for id_, number in zip(graph.fragments, numbers, strict=True)
    }
    renamed = [
        replace(m, pair=FragmentPair(names[m.pair.source], names[m.pair.target]))
        for m in graph.measurements
    ]
    one = placed(solve(method, graph))
    other = placed(method.synchronize(list(names.values()), renamed))
    anchor = graph.fragments[0]
    for id_ in graph.fragments:
        apart = relative(
            relative(one[id_], one[anchor]), relative(other[names[id_]], other[names[anchor]])
        )
        assert np.linalg.norm(apart[:3, 3]) < 1e-3
        assert rotation_angle(apart) < 1e-4


def test_parts_that_nothing_links_have_frames_of_their_own(method):
    one, other = graph_of(0, EXACT), graph_of(1, EXACT)
    moved = {id_: replace(id_, area="2") for id_ in other.fragments}
    measurements = list(one.measurements) + [
        replace(m, pair=FragmentPair(moved[m.pair.source], moved[m.pair.target]))
        for m in other.measurements
    ]
    alone = FragmentId("3", 1, 1)
    stranger = FragmentPair(FragmentId("4", 1, 1), alone)
    measurements.append(Measurement(stranger, np.eye(4)))
    result = method.synchronize([*one.fragments, *moved.values(), alone], measurements)
    nodes = {node.id: node for node in result.nodes}
    assert [node.id for node in result.nodes] == sorted(nodes)
    assert nodes[alone].status is NodeStatus.UNPLACED
    assert len({nodes[id_].component for id_ in one.fragments}) == 1
    assert {nodes[i].component for i in one.fragments} != {
        nodes[i].component for i in moved.values()
    }
    by_itself = {node.id: node for node in solve(method, one).nodes}
    for id_ in one.fragments:
        assert np.array_equal(nodes[id_].T_map_fragment, by_itself[id_].T_map_fragment)
    assert result.edges[-1].reason == "unknown fragment"
    assert len(result.edges) == len(measurements)


def test_fragments_without_edges_are_unplaced(method):
    ids = [FragmentId("1", 1, spot) for spot in (1, 2, 3)]
    for some in ([], ids[:1], ids):
        result = method.synchronize(some, [])
        assert [node.id for node in result.nodes] == some
        assert {node.status for node in result.nodes} <= {NodeStatus.UNPLACED}
        assert result.edges == ()
        assert result.synchronizer == "posegraphnet"


def test_manual_constraints_are_kept_and_hopeless_edges_are_not():
    ids = [FragmentId("1", 1, spot) for spot in (1, 2, 3)]
    there = from_yaw(0.3, (2.0, 1.0, 0.0))
    pairs = [
        FragmentPair(ids[0], ids[1]),
        FragmentPair(ids[1], ids[2]),
        FragmentPair(ids[2], ids[0]),
    ]
    wrong = Measurement(pairs[0], inverse(there) @ from_yaw(2.0, (5, 5, 0)), manual=True)
    tilted = Measurement(pairs[1], np.diag((1.0, -1, -1, 1)), level=True)
    doubtful = Measurement(pairs[2], there, confidence=0.1)
    choosy = PoseGraphNet(MultiwayConfig(min_confidence=0.5))
    result = choosy.synchronize(ids, [Measurement(pairs[0], there), wrong, tilted, doubtful])
    edges = [edge for edge in result.edges if edge.kind.name == "MANUAL"]
    assert [edge.status for edge in edges] == [EdgeStatus.ACCEPTED]
    reasons = {edge.pair: edge.reason for edge in result.edges}
    assert "tilts" in reasons[pairs[1]]
    assert "min_confidence" in reasons[pairs[2]]


def published(path, width=256, **changes):
    """A checkpoint laid out as those of the authors."""
    torch.manual_seed(0)
    network = SynchronizationNetwork(width)
    state = {**network.state_dict(), **changes}
    torch.save({"state_dict": state, "optimizer": {"state": {}}, "step": 1}, path)
    return network


def test_published_checkpoints_are_run_as_by_their_authors(tmp_path):
    path = tmp_path / "published.pth"
    network = published(path)
    loaded, usage = load_weights(str(path))
    assert usage == Usage("identity", 10, 1)
    for name, tensor in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor.double())
    graph = graph_of(0)
    method = PoseGraphNet(MultiwayConfig(posegraphnet_weights=str(path)))
    result = solve(method, graph)
    assert len(result.nodes) == len(graph.fragments)
    assert fingerprint(result) != fingerprint(solve(PoseGraphNet(MultiwayConfig()), graph))


@pytest.mark.parametrize(
    "changes",
    [
        {"extra": torch.zeros(1)},
        {"meta_op.node_model.node_mlp_2.2.bias": torch.zeros(21)},
        {"meta_op.node_model.node_mlp_1.0.weight": torch.zeros(7)},
    ],
)
def test_checkpoints_of_other_networks_are_refused(tmp_path, changes):
    path = tmp_path / "other.pth"
    published(path, **changes)
    with pytest.raises(MethodError, match="posegraphnet_weights"):
        PoseGraphNet(MultiwayConfig(posegraphnet_weights=str(path)))


def test_files_that_are_no_checkpoints_are_refused(tmp_path):
    path = tmp_path / "text.pth"
    path.write_text("no weights")
    for each in (path, tmp_path / "missing.pth"):
        with pytest.raises(MethodError, match=each.name):
            load_weights(str(each))
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(MethodError, match="another network"):
        load_weights(str(tmp_path / "other.safetensors"))


def test_weights_know_how_they_are_run(tmp_path):
    path = tmp_path / "own.safetensors"
    network = SynchronizationNetwork(8)
    save_weights(path, network, Usage("tree", 3, 2))
    assert load_weights(str(path))[1] == Usage("tree", 3, 2)
    tensors = {name: t.contiguous() for name, t in network.state_dict().items()}
    save_file(tensors, path)
    assert load_weights(str(path))[1] == Usage()
    for wrong in ('{"start": "nowhere"}', '{"steps": 0}', "{", '{"unknown": 1}'):
        save_file(tensors, path, {"posegraphnet": wrong})
        with pytest.raises(MethodError, match="how its network is run"):
            load_weights(str(path))
