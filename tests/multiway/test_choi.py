from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import exponential, from_rotation, inverse, relative, rotation_angle
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.pose_graph import (
    Alternative,
    EdgeKind,
    EdgeStatus,
    Measurement,
    NodeStatus,
)
from nss_ros.multiway.synchronizer import load_synchronizer, synchronizer_names

_STARTS = ["evidence", "triangles", "confidence"]


def random_pose(random, size=10.0):
    return from_rotation(Rotation.random(rng=random), random.uniform(-size, size, 3))


def measured(pair, T_target_source, **fields):
    information = np.diag([1 / 0.02**2] * 3 + [1 / 0.01**2] * 3)
    return Measurement(pair, T_target_source, information, **{"inliers": 1000, **fields})


class World:
    """Random fragments of an area, their true poses, and true pairs between them."""

    def __init__(self, count, seed, per_node=6.0, area="1", stages=3):
        self.random = np.random.default_rng(seed)
        self.ids = sorted(FragmentId(area, i % stages + 1, i) for i in range(count))
        self.poses = {id_: random_pose(self.random) for id_ in self.ids}
        every = list(combinations(self.ids, 2))
        keep = self.random.random(len(every)) < per_node / max(count - 1, 1)
        chain = set(zip(self.ids, self.ids[1:], strict=False))
        chosen = [p for p, kept in zip(every, keep, strict=True) if kept or p in chain]
        turned = self.random.random(len(chosen)) < 0.5
        self.pairs = [
            FragmentPair(*(pair[::-1] if turn else pair))
            for pair, turn in zip(chosen, turned, strict=True)
        ]

    def truth(self, pair):
        return relative(self.poses[pair.source], self.poses[pair.target])

    def measurements(self, noise=0.0, wrong=0.0):
        """Noisy relative transforms, a share of them replaced by random ones; which are right."""
        right = self.random.random(len(self.pairs)) >= wrong
        result = []
        for pair, is_right in zip(self.pairs, right, strict=True):
            twist = self.random.normal(0, 1, 6) * noise
            truth = exponential(twist) @ self.truth(pair)
            # Confidence hardly tells right from wrong, as in a repetitive building.
            confidence = self.random.uniform(0.2, 1.0) if is_right else self.random.uniform(0, 0.9)
            result.append(
                measured(
                    pair, truth if is_right else random_pose(self.random), confidence=confidence
                )
            )
        return result, right


def solve(world, measurements, **settings):
    return Choi(MultiwayConfig(**settings)).synchronize(world.ids, measurements)


def worst_error(world, graph):
    """Largest error (m, rad) over all pairs of fragments that share a component."""
    placed = [node for node in graph.nodes if node.status is NodeStatus.PLACED]
    errors = [(0.0, 0.0)]
    for one, other in combinations(placed, 2):
        if one.component == other.component:
            truth = world.truth(FragmentPair(one.id, other.id))
            found = relative(one.T_map_fragment, other.T_map_fragment)
            difference = inverse(truth) @ found
            errors.append((np.linalg.norm(difference[:3, 3]), rotation_angle(difference)))
    return max(e[0] for e in errors), max(e[1] for e in errors)


def fingerprint(graph):
    nodes = [
        (n.id, n.status, n.component, n.T_map_fragment.tobytes(), n.covariance.tobytes())
        for n in graph.nodes
    ]
    edges = [
        (
            e.pair,
            e.status,
            e.reason,
            e.weight,
            repr(e.residual_translation),
            repr(e.residual_rotation),
        )
        for e in graph.edges
    ]
    return nodes, edges


@settings(max_examples=15, deadline=None)
@given(st.integers(2, 25), st.integers(0, 10_000), st.sampled_from(_STARTS))
def test_graphs_without_noise_are_solved_exactly(count, seed, start):
    world = World(count, seed)
    graph = solve(world, world.measurements()[0], start=start, bridge_confidence=0.0)
    assert [node.id for node in graph.nodes] == world.ids
    assert {node.status for node in graph.nodes} == {NodeStatus.PLACED}
    assert {node.component for node in graph.nodes} == {0}
    assert {edge.status for edge in graph.edges} == {EdgeStatus.ACCEPTED}
    translation, rotation = worst_error(world, graph)
    assert translation < 1e-4
    assert rotation < 1e-5
    assert np.allclose(graph.nodes[0].T_map_fragment, np.eye(4))
    assert graph.rms_residual() < 1e-4


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("wrong", [0.2, 0.4])
def test_random_outliers_are_rejected(seed, wrong):
    world = World(40, seed, per_node=10.0)
    measurements, right = world.measurements(noise=0.003, wrong=wrong)
    # Nothing can tell whether an edge is right that no loop confirms.
    graph = solve(world, measurements, bridge_confidence=1.0)
    accepted = {edge.pair for edge in graph.edges if edge.status is EdgeStatus.ACCEPTED}
    true = {pair for pair, is_right in zip(world.pairs, right, strict=True) if is_right}
    assert accepted <= true
    assert len(accepted) >= 0.97 * len(true)
    rejected = [edge for edge in graph.edges if edge.status is EdgeStatus.REJECTED]
    assert all(edge.reason and edge.weight == 0 for edge in rejected)
    assert all(0.25 < e.weight <= 1 for e in graph.edges if e.status is EdgeStatus.ACCEPTED)
    translation, rotation = worst_error(world, graph)
    assert translation < 0.1
    assert rotation < 0.01


def test_the_triangle_start_survives_six_of_ten_wrong_where_confidence_fails():
    world = World(100, 0, per_node=15.0)
    measurements, right = world.measurements(noise=0.003, wrong=0.6)
    true = {pair for pair, is_right in zip(world.pairs, right, strict=True) if is_right}
    accepted = {}
    for start in _STARTS:
        graph = solve(world, measurements, start=start, bridge_confidence=1.0)
        accepted[start] = {e.pair for e in graph.edges if e.status is EdgeStatus.ACCEPTED}
        if start != "confidence":
            assert sum(node.component == 0 for node in graph.nodes) >= 98
            assert worst_error(world, graph)[0] < 0.2
    for start in ("evidence", "triangles"):
        assert accepted[start] <= true
        assert len(accepted[start]) >= 0.98 * len(true)
    assert len(accepted["confidence"] & true) < 0.5 * len(true)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_of_the_arguments_does_not_matter(seed):
    world = World(12, seed)
    measurements, _ = world.measurements(noise=0.01, wrong=0.3)
    order = world.random.permutation(len(measurements))
    shuffled = [measurements[i] for i in order]
    ids = [world.ids[i] for i in world.random.permutation(len(world.ids))]
    choi = Choi(MultiwayConfig())
    assert fingerprint(choi.synchronize(world.ids, measurements)) == fingerprint(
        choi.synchronize(ids, shuffled)
    )


def test_components_have_map_frames_of_their_own_the_largest_first():
    small, large = World(4, 1, area="A"), World(6, 2, area="B")
    both = World(0, 0)
    both.ids = small.ids + large.ids
    both.poses = small.poses | large.poses
    graph = solve(both, small.measurements()[0] + large.measurements()[0], bridge_confidence=0.0)
    component = {node.id: node.component for node in graph.nodes}
    assert {component[id_] for id_ in large.ids} == {0}
    assert {component[id_] for id_ in small.ids} == {1}
    assert worst_error(both, graph)[0] < 1e-4
    for ids in (small.ids, large.ids):
        anchor = next(node for node in graph.nodes if node.id == min(ids))
        assert np.allclose(anchor.T_map_fragment, np.eye(4))
        assert not anchor.covariance.any()


def test_a_flip_by_half_a_turn_is_rejected():
    world = World(5, 3, per_node=4.0)
    measurements, _ = world.measurements()
    flip = from_rotation(Rotation.from_euler("x", np.pi), np.zeros(3))
    measurements[2] = replace(
        measurements[2], T_target_source=measurements[2].T_target_source @ flip
    )
    graph = solve(world, measurements)
    status = {edge.pair: edge.status for edge in graph.edges}
    assert status.pop(world.pairs[2]) is EdgeStatus.REJECTED
    assert set(status.values()) == {EdgeStatus.ACCEPTED}
    assert worst_error(world, graph)[0] < 1e-3
    flipped = next(edge for edge in graph.edges if edge.pair == world.pairs[2])
    assert flipped.residual_rotation == pytest.approx(np.pi, abs=1e-3)


def test_manual_constraints_are_never_rejected_and_join_components():
    small, large = World(4, 1, area="A"), World(6, 2, area="B")
    both = World(0, 0)
    both.ids = small.ids + large.ids
    both.poses = small.poses | large.poses
    link = FragmentPair(small.ids[2], large.ids[1])
    manual = measured(link, both.truth(link), manual=True, inliers=0)
    measurements = small.measurements()[0] + large.measurements()[0]
    graph = solve(both, [*measurements, manual])
    assert {node.component for node in graph.nodes} == {0}
    assert worst_error(both, graph)[0] < 1e-3
    edge = next(edge for edge in graph.edges if edge.pair == link)
    assert (edge.kind, edge.status) == (EdgeKind.MANUAL, EdgeStatus.ACCEPTED)


def test_contradicting_manual_constraints_do_not_crash():
    world = World(5, 0)
    pair = FragmentPair(world.ids[0], world.ids[4])
    manual = [
        measured(pair, random_pose(world.random), manual=True, inliers=0),
        measured(pair, random_pose(world.random), manual=True, inliers=0),
        measured(FragmentPair(pair.target, pair.source), np.eye(4), manual=True, inliers=0),
    ]
    graph = solve(world, world.measurements()[0] + manual)
    kept = [edge for edge in graph.edges if edge.kind is EdgeKind.MANUAL]
    assert len(kept) == 3
    assert {edge.status for edge in kept} == {EdgeStatus.ACCEPTED}
    assert all(np.isfinite(node.T_map_fragment).all() for node in graph.nodes)


def test_both_directions_of_a_pair_are_used():
    world = World(2, 0)
    pair = world.pairs[0]
    # One place, so that no lever arm lets a turn explain a shift.
    world.poses = dict.fromkeys(world.ids, random_pose(world.random))
    there = exponential((0.02, 0, 0, 0, 0, 0)) @ world.truth(pair)
    back = inverse(exponential((-0.02, 0, 0, 0, 0, 0)) @ world.truth(pair))
    graph = solve(
        world, [measured(pair, there), measured(FragmentPair(pair.target, pair.source), back)]
    )
    assert [edge.status for edge in graph.edges] == [EdgeStatus.ACCEPTED] * 2
    assert worst_error(world, graph)[0] < 0.005


def test_tilted_edges_of_levelled_fragments_are_rejected_at_once():
    world = World(3, 0)
    tilted = from_rotation(Rotation.from_euler("x", 12, degrees=True), np.zeros(3))
    pair = world.pairs[0]
    for level, status in ((True, EdgeStatus.REJECTED), (False, EdgeStatus.ACCEPTED)):
        graph = solve(world, [measured(pair, tilted, level=level)])
        assert graph.edges[0].status is status
        assert ("tilts levelled fragments by 12.0 deg" in graph.edges[0].reason) == level


def test_unknown_fragments_and_low_confidence_are_named():
    world = World(3, 0)
    stranger = FragmentPair(FragmentId("9", 9, 9), world.ids[0])
    measurements, _ = world.measurements()
    doubtful = replace(measurements[0], confidence=0.1)
    graph = solve(
        world, [doubtful, *measurements[1:], measured(stranger, np.eye(4))], min_confidence=0.2
    )
    reasons = {edge.pair: edge.reason for edge in graph.edges}
    assert reasons[stranger] == "unknown fragment"
    assert "min_confidence" in reasons[doubtful.pair]
    assert [node.id for node in graph.nodes] == world.ids


def test_fragments_without_edges_are_unplaced():
    world = World(4, 0)
    for ids, measurements in (([], []), (world.ids[:1], []), (world.ids, [])):
        graph = Choi(MultiwayConfig()).synchronize(ids, measurements)
        assert [node.id for node in graph.nodes] == list(ids)
        assert all(node.status is NodeStatus.UNPLACED for node in graph.nodes)
        assert graph.edges == ()
    nothing_fits = [measured(world.pairs[0], random_pose(world.random), confidence=0.0)]
    graph = solve(world, nothing_fits)
    assert all(node.status is NodeStatus.UNPLACED for node in graph.nodes)
    assert np.isnan(graph.edges[0].residual_translation)


def test_covariances_grow_along_a_chain():
    world = World(6, 0, per_node=0.0)
    graph = solve(world, [replace(m, confidence=1.0) for m in world.measurements()[0]])
    spread = [float(np.linalg.eigvalsh(node.covariance)[-1]) for node in graph.nodes]
    assert spread[0] == 0
    assert spread == sorted(spread)
    for node in graph.nodes[1:]:
        assert np.allclose(node.covariance, node.covariance.T)
        assert np.linalg.eigvalsh(node.covariance)[0] > 0
    # The first step alone: the covariance of its measurement, moved to the map frame.
    step = FragmentPair(world.ids[1], world.ids[0])
    direct = solve(world, [measured(step, world.truth(step))])
    expected = np.diag([0.02**2] * 3 + [0.01**2] * 3)
    assert np.allclose(direct.nodes[1].covariance, expected, rtol=0.01, atol=1e-7)


@settings(max_examples=10)
@given(st.integers(0, 10_000))
def test_a_start_near_the_truth_finds_it(seed):
    world = World(15, seed)
    measurements, _ = world.measurements(noise=0.002, wrong=0.3)
    start = {
        id_: pose @ exponential(world.random.normal(0, 0.02, 6))
        for id_, pose in world.poses.items()
    }
    graph = Choi(MultiwayConfig(bridge_confidence=1.0)).synchronize(world.ids, measurements, start)
    translation, rotation = worst_error(world, graph)
    assert translation < 0.2
    assert rotation < 0.02
    assert len(graph.edges) == len(measurements)


def test_a_start_decides_where_the_measurements_do_not():
    """Two measurements of one pair that are equally likely, and far from each other."""
    world = World(2, 0)
    pair = world.pairs[0]
    there, elsewhere = world.truth(pair), world.truth(pair) @ random_pose(world.random, 3)
    measurements = [measured(pair, each, confidence=0.9) for each in (there, elsewhere)]
    for right in (there, elsewhere):
        start = {pair.target: np.eye(4), pair.source: right}
        graph = Choi(MultiwayConfig()).synchronize(world.ids, measurements, start)
        accepted = [edge for edge in graph.edges if edge.status is EdgeStatus.ACCEPTED]
        assert [np.allclose(edge.T_target_source, right) for edge in accepted] == [True]


def test_a_start_leaves_the_hypotheses_as_they_are():
    world = World(3, 0, per_node=4.0)
    alternative = Alternative(random_pose(world.random), np.eye(6), 0.3)
    measurements = [replace(m, alternatives=(alternative,)) for m in world.measurements()[0]]
    graph = Choi(MultiwayConfig()).synchronize(world.ids, measurements, world.poses)
    for edge in graph.edges:
        assert edge.status is EdgeStatus.ACCEPTED
        assert np.allclose(edge.T_target_source, world.truth(edge.pair))


def test_measurements_that_are_rejected_become_edges_and_nothing_else():
    world = World(8, 1)
    measurements, _ = world.measurements()
    wrong = [
        (measured(pair, random_pose(world.random), confidence=1.0), f"reason {number}")
        for number, pair in enumerate(world.pairs[:3])
    ]
    lone = FragmentPair(FragmentId("9", 1, 1), FragmentId("9", 1, 2))
    wrong.append((measured(lone, np.eye(4)), "alone"))
    ids = [*world.ids, lone.source, lone.target]
    choi = Choi(MultiwayConfig())
    without = choi.synchronize(ids, measurements)
    graph = choi.synchronize(ids, measurements, rejected=wrong)
    assert fingerprint(graph)[0] == fingerprint(without)[0]
    assert fingerprint(graph)[1][: len(measurements)] == fingerprint(without)[1]
    added = graph.edges[len(measurements) :]
    assert [edge.pair for edge in added] == [m.pair for m, _ in wrong]
    assert [edge.reason for edge in added] == [reason for _, reason in wrong]
    assert {(edge.status, edge.weight) for edge in added} == {(EdgeStatus.REJECTED, 0.0)}
    assert all(edge.residual_translation > 0.1 for edge in added[:3])
    assert np.isnan(added[3].residual_translation)
    assert {node.status for node in graph.nodes if node.id.area == "9"} == {NodeStatus.UNPLACED}


def test_the_kind_of_an_edge_is_that_of_its_measurement():
    one, other, later = (FragmentId("1", stage, 1) for stage in (1, 1, 2))
    other = replace(other, spot=2)
    within = measured(FragmentPair(one, other), np.eye(4))
    across = measured(FragmentPair(one, later), np.eye(4))
    kinds = {
        EdgeKind.SAME_STAGE: within,
        EdgeKind.DIFFERENT_STAGE: across,
        EdgeKind.SUBMAP: replace(across, submap=True),
        EdgeKind.MANUAL: replace(within, manual=True, submap=True),
    }
    for kind, m in kinds.items():
        assert m.kind is kind
        graph = Choi(MultiwayConfig()).synchronize([one, other, later], [m])
        assert [edge.kind for edge in graph.edges] == [kind]


def test_choi_is_found_by_name():
    assert "choi" in synchronizer_names()
    assert load_synchronizer(MultiwayConfig(synchronizer="choi")).name == "choi"


def bent(building, ids, turn=0.01):
    """True poses, each turned a little more than the last, and moved along with it."""
    part = building.part(ids)
    return {
        id_: exponential(np.array([0, 0, 0, 0, 0, turn * n])) @ part[id_]
        for n, id_ in enumerate(ids)
    }


def test_a_bent_part_is_straightened_by_all_pairs_that_agree_with_it(building):
    ids = sorted({end for p in building.pairs if p.same_stage for end in (p.source, p.target)})
    ids = [id_ for id_ in ids if id_.stage == 1]
    measurements = [building.right(pair) for pair in building.asked(ids)]
    measurements += [building.wrong(pair, n) for n, pair in enumerate(building.asked(ids)[:9])]
    choi = Choi(MultiwayConfig())
    part = bent(building, ids)
    assert building.worst(part)[0] > 0.3
    straight = choi.straightened(part, measurements)
    assert straight.keys() == part.keys()
    assert building.worst(straight)[0] < 0.02


def test_a_part_that_would_fall_apart_stays_as_it_is(building):
    ids = building.spots(1, 1, 2, 4, 6, 7)
    part, choi = bent(building, ids), Choi(MultiwayConfig())
    assert choi.straightened(part, []) is part
    some = [building.right(pair) for pair in building.asked(ids[:3])]
    assert choi.straightened(part, some) is part
    assert choi.straightened({ids[0]: np.eye(4)}, some).keys() == {ids[0]}
