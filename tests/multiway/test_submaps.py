"""The synchronizer `submaps`, by fragments of two stages of the bundled bag."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.pose_graph import EdgeKind, EdgeStatus, NodeStatus
from nss_ros.multiway.submaps import Submaps
from nss_ros.multiway.synchronizer import (
    PointSynchronizer,
    load_synchronizer,
    synchronizer_names,
)

CONFIG = MultiwayConfig()


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2, 4, 6), *building.spots(2, 4, 5, 6)]


@pytest.fixture(scope="module")
def pairs(building, ids):
    return building.asked(ids)


@pytest.fixture(scope="module")
def right(building, pairs):
    return [building.right(pair) for pair in pairs]


@pytest.fixture(scope="module")
def synchronizer():
    return Submaps(CONFIG)


@pytest.fixture(scope="module")
def solve(building, synchronizer):
    def solved(ids, measurements, prepared=None):
        usable = building.prepared if prepared is None else prepared
        return synchronizer.synchronize_points(ids, measurements, usable)

    return solved


def assert_placed_rightly(building, graph, ids):
    placed = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
    assert placed.keys() == set(ids)
    assert {graph.poses()[id_].component for id_ in ids} == {0}
    distance, angle = building.worst(placed)
    assert distance < 0.15
    assert angle < 3


def answers(graph):
    return [edge for edge in graph.edges if edge.kind is not EdgeKind.SUBMAP]


def fingerprint(graph):
    nodes = [
        (n.id, n.status, n.component, n.T_map_fragment.tobytes(), n.covariance.tobytes())
        for n in graph.nodes
    ]
    edges = [
        (e.pair, e.kind, e.status, e.reason, e.weight, e.T_target_source.tobytes())
        for e in graph.edges
    ]
    return nodes, sorted(edges)


def test_it_is_the_default_and_takes_points():
    assert "submaps" in synchronizer_names()
    found = load_synchronizer(CONFIG)
    assert found.name == "submaps"
    assert isinstance(found, PointSynchronizer)
    assert not isinstance(Choi(CONFIG), PointSynchronizer)


def test_right_measurements_are_all_accepted(building, solve, ids, right):
    graph = solve(ids, right)
    assert graph.synchronizer == "submaps"
    assert_placed_rightly(building, graph, ids)
    assert {edge.status for edge in answers(graph)} == {EdgeStatus.ACCEPTED}
    assert [node.id for node in graph.nodes] == sorted(ids)


def test_confident_measurements_that_are_wrong_are_rejected(building, solve, ids, pairs):
    wrong = {pairs[n] for n in range(0, len(pairs), 3)}
    measurements = [
        building.wrong(pair, n, confidence=0.97) if pair in wrong else building.right(pair)
        for n, pair in enumerate(pairs)
    ]
    graph = solve(ids, measurements)
    assert_placed_rightly(building, graph, ids)
    rejected = [edge for edge in answers(graph) if edge.status is EdgeStatus.REJECTED]
    assert {edge.pair for edge in rejected} == wrong
    for edge in rejected:
        assert edge.reason == "none of its hypotheses agrees with the submaps"
        assert edge.weight == 0
        assert edge.residual_translation > 0.15 or edge.residual_rotation > np.radians(2.5)


def test_the_alternative_that_fits_becomes_the_edge(building, solve, ids, pairs):
    measurements = [building.wrong(pair, n, 0.5, 0.3) for n, pair in enumerate(pairs)]
    graph = solve(ids, measurements)
    assert_placed_rightly(building, graph, ids)
    for edge in answers(graph):
        assert edge.status is EdgeStatus.ACCEPTED
        assert np.allclose(edge.T_target_source, building.truth(edge.pair))


def test_every_measurement_becomes_an_edge_and_those_of_submaps_are_extra(
    building, solve, ids, pairs
):
    measurements = [
        building.wrong(pair, n, 0.6) if n % 2 else building.right(pair)
        for n, pair in enumerate(pairs)
    ]
    turned = building.right(FragmentPair(pairs[0].target, pairs[0].source))
    measurements += [measurements[0], turned]
    graph = solve(ids, measurements)
    assert Counter(edge.pair for edge in answers(graph)) == Counter(m.pair for m in measurements)
    extra = [edge for edge in graph.edges if edge.kind is EdgeKind.SUBMAP]
    assert extra
    assert all(edge.pair.source in ids and edge.pair.target in ids for edge in extra)
    accepted = {edge.pair for edge in answers(graph) if edge.status is EdgeStatus.ACCEPTED}
    assert not accepted & {edge.pair for edge in extra}
    for edge in extra:
        distance, angle = building.error(edge.T_target_source, edge.pair.source, edge.pair.target)
        assert distance < 0.15
        assert angle < 3


def test_the_order_of_the_arguments_does_not_matter(building, solve, ids, pairs):
    random = np.random.default_rng(0)
    measurements = [building.wrong(pair, n, 0.5, 0.3) for n, pair in enumerate(pairs)]
    shuffled = [measurements[n] for n in random.permutation(len(measurements))]
    others = [ids[n] for n in random.permutation(len(ids))]
    known = list(building.prepared)
    prepared = {known[n]: building.prepared[known[n]] for n in random.permutation(len(known))}
    expected = solve(ids, measurements)
    assert fingerprint(solve(others, shuffled, prepared)) == fingerprint(expected)
    assert fingerprint(solve([*ids, *ids], measurements)) == fingerprint(expected)


def test_stages_without_pairs_between_them_are_one_map(building, solve, ids, right):
    graph = solve(ids, [m for m in right if m.pair.same_stage])
    assert_placed_rightly(building, graph, ids)


def test_manual_constraints_are_kept(building, solve, ids, right):
    pair = FragmentPair(ids[-1], ids[0])
    for manual in (
        building.right(pair, manual=True),
        replace(building.wrong(pair, 2), manual=True, inliers=0),
    ):
        graph = solve(ids, [*right, manual])
        (edge,) = (edge for edge in graph.edges if edge.kind is EdgeKind.MANUAL)
        assert (edge.pair, edge.status, edge.weight) == (pair, EdgeStatus.ACCEPTED, 1.0)
        assert np.array_equal(edge.T_target_source, manual.T_target_source)
        assert all(np.isfinite(node.T_map_fragment).all() for node in graph.nodes)


def test_a_constraint_alone_joins_what_does_not_touch(building, solve, ids):
    far = building.spots(3, 7)[0]
    manual = building.right(FragmentPair(far, ids[0]), manual=True)
    graph = solve([ids[0], far], [manual])
    assert_placed_rightly(building, graph, [ids[0], far])


def test_a_constraint_joins_two_areas(building, solve, ids, right):
    """A person says where they are to each other, and not where they would look alike."""
    others = {id_: FragmentId("2", id_.stage, id_.spot) for id_ in ids}
    prepared = building.prepared | {
        other: replace(building.prepared[id_], id=other) for id_, other in others.items()
    }
    twice = [
        replace(m, pair=FragmentPair(others[m.pair.source], others[m.pair.target])) for m in right
    ]
    there = from_yaw(2.5, (30.0, 5.0, 0.0))
    link = FragmentPair(others[ids[0]], ids[0])
    manual = replace(right[0], pair=link, T_target_source=there, manual=True)
    graph = solve([*ids, *others.values()], [*right, *twice, manual], prepared)
    poses = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
    assert len(poses) == 2 * len(ids)
    assert {node.component for node in graph.nodes} == {0}
    found = relative(poses[link.source], poses[link.target])
    assert np.allclose(found, there, atol=0.05)
    for part in (ids, others.values()):
        same = {FragmentId("1", id_.stage, id_.spot): poses[id_] for id_ in part}
        assert building.worst(same)[0] < 0.15


def test_fragments_that_are_not_levelled_are_passed_on(building, solve, synchronizer, ids, right):
    tilted = ids[1]
    fragment = building.fragments[tilted]
    assert synchronizer.prepare(Fragment(tilted, fragment.points, False)) is None
    prepared = {id_: each for id_, each in building.prepared.items() if id_ != tilted}
    graph = solve(ids, right, prepared)
    assert_placed_rightly(building, graph, ids)
    touching = [edge for edge in graph.edges if tilted in (edge.pair.source, edge.pair.target)]
    assert touching
    assert all(edge.kind is not EdgeKind.SUBMAP for edge in touching)
    assert {edge.status for edge in touching} == {EdgeStatus.ACCEPTED}


def test_with_nothing_prepared_it_is_choi(building, synchronizer, ids, pairs):
    measurements = [building.wrong(pair, n, 0.5, 0.4) for n, pair in enumerate(pairs)]
    expected = Choi(CONFIG).synchronize(ids, measurements)
    for graph in (
        synchronizer.synchronize(ids, measurements),
        synchronizer.synchronize_points(ids, measurements, {}),
    ):
        assert graph.synchronizer == "submaps"
        assert fingerprint(graph) == fingerprint(expected)


def test_nothing_to_go_by_is_no_failure(building, solve, ids):
    assert solve([], []).nodes == ()
    for few in (ids[:1], [ids[0], ids[-1]], building.spots(1, 5) + building.spots(3, 7)):
        graph = solve(few, [])
        assert [node.id for node in graph.nodes] == sorted(few)
        assert {node.status for node in graph.nodes} == {NodeStatus.UNPLACED}
        assert graph.edges == ()


def test_measurements_of_unknown_fragments_are_rejected(building, solve, ids, right):
    """Answers may come before their fragments, or after a reset."""
    known = building.right(FragmentPair(building.spots(3, 1)[0], ids[0]))
    stranger = replace(known, pair=FragmentPair(FragmentId("9", 9, 9), ids[0]))
    graph = solve(ids, [*right, known, stranger])
    assert_placed_rightly(building, graph, ids)
    reasons = {edge.pair: edge.reason for edge in graph.edges}
    assert reasons[stranger.pair] == reasons[known.pair] == "unknown fragment"


def test_what_links_parts_that_stay_apart_is_rejected(building, solve):
    source, target = building.spots(3, 7)[0], building.spots(1, 5)[0]
    doubtful = building.wrong(FragmentPair(source, target), 0, confidence=0.05)
    graph = solve([source, target], [doubtful])
    assert {node.status for node in graph.nodes} == {NodeStatus.UNPLACED}
    (edge,) = graph.edges
    assert edge.status is EdgeStatus.REJECTED
    assert edge.reason == "too little speaks for joining the submaps that it links"


@pytest.mark.parametrize(
    "cloud",
    [
        np.ones((2000, 3)),
        np.linspace(-4, 4, 4000)[:, None] * np.array([[1.0, 0.3, 0.1]]),
        np.random.default_rng(0).uniform(-3, 3, (6000, 3)) * (1, 1, 0) - (0, 0, 1.5),
        np.random.default_rng(0).uniform(-6, 6, (3000, 3)),
        np.random.default_rng(0).uniform(-3, 3, (6000, 3)) * (1, 1, 0) + (0, 0, 60),
    ],
    ids=["equal points", "line", "floor", "scattered", "high above"],
)
def test_a_strange_cloud_does_no_harm(building, solve, synchronizer, ids, right, cloud):
    strange = Fragment(FragmentId("1", 2, 77), cloud.astype(np.float32), True)
    prepared = dict(building.prepared)
    if (made := synchronizer.prepare(strange)) is not None:
        prepared[strange.id] = made
    misled = replace(right[0], pair=FragmentPair(strange.id, ids[0]), confidence=0.05)
    graph = solve([*ids, strange.id], [*right, misled], prepared)
    placed = {id_: node.T_map_fragment for id_, node in graph.poses().items() if id_ in ids}
    assert len(placed) == len(ids)
    assert building.worst(placed)[0] < 0.15
    assert len(graph.nodes) == len(ids) + 1


def test_weights_that_are_none_are_an_error(tmp_path):
    path = tmp_path / "weights.safetensors"
    with pytest.raises(MethodError, match="weights"):
        Submaps(MultiwayConfig(submap_weights=str(path)))
    path.write_bytes(b"nothing")
    with pytest.raises(MethodError, match="weights"):
        load_synchronizer(MultiwayConfig(submap_weights=str(path)))
