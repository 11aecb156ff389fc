"""What was found with points stays in force while further answers come in."""

from dataclasses import replace

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.known import known_by
from nss_ros.multiway.pose_graph import (
    Alternative,
    Edge,
    EdgeKind,
    EdgeStatus,
    Measurement,
    Node,
    NodeStatus,
    PoseGraph,
)
from nss_ros.multiway.spanning_tree import Closeness
from nss_ros.multiway.submaps import Submaps

CLOSE = Closeness(0.4, np.radians(6))
INFORMATION = np.diag([1 / 0.02**2] * 3 + [1 / 0.01**2] * 3)
A, B, C, D, E, F = (FragmentId("1", 1, spot) for spot in range(6))
POSES = {
    id_: from_yaw(0.4 * number, (2.0 * number, 0.3 * number**2, 0.0))
    for number, id_ in enumerate((A, B, C, D, E))
}


def there(source, target):
    return relative(POSES[source], POSES[target])


def answer(source, target, T_target_source=None, alternatives=(), **fields):
    transform = there(source, target) if T_target_source is None else T_target_source
    return Measurement(
        FragmentPair(source, target),
        transform,
        INFORMATION,
        **{"confidence": 0.5, "inliers": 700, "alternatives": alternatives} | fields,
    )


def edge(source, target, kind=EdgeKind.SAME_STAGE, accepted=True):
    status = EdgeStatus.ACCEPTED if accepted else EdgeStatus.REJECTED
    covariance = np.linalg.inv(INFORMATION)
    transform = there(source, target)
    pair = FragmentPair(source, target)
    return Edge(pair, transform, kind, status, "why", covariance=covariance, inliers=300)


def solution(*edges, component=None):
    """A to D are in one component, or as told; E is in none."""
    component = component or {}
    nodes = [
        Node(id_, POSES[id_], NodeStatus.PLACED, component.get(id_, 0)) for id_ in (A, B, C, D)
    ]
    return PoseGraph((*nodes, Node(E)), edges)


ANSWERS = [answer(A, B), answer(B, C), answer(C, D), answer(B, D)]
"""The first three link all; the last is rejected."""
SOLUTION = solution(
    edge(A, B), edge(B, C), edge(C, D), edge(B, D, accepted=False), edge(A, C, EdgeKind.SUBMAP)
)


def pairs(measurements):
    return [(m.pair.source, m.pair.target) for m in measurements]


def members(known):
    return [set(part) for part in known.parts]


def test_what_was_decided_stays():
    known = known_by(SOLUTION, ANSWERS, CLOSE)
    (part,) = known.parts
    assert part.keys() == {A, B, C, D}
    assert all(np.array_equal(pose, POSES[id_]) for id_, pose in part.items())
    assert pairs(known.measurements) == [(A, B), (B, C), (C, D), (A, C)]
    assert [(m.pair, why) for m, why in known.rejected] == [(FragmentPair(B, D), "why")]
    found = known.measurements[-1]
    assert (found.kind, found.inliers, found.level) == (EdgeKind.SUBMAP, 300, True)
    assert {m.confidence for m in known.measurements} == {0.9}


def test_the_hypothesis_that_was_right_stays():
    wrong = from_yaw(2.0, (4.0, 4.0, 0.0))
    right = Alternative(there(A, B), INFORMATION * 2, 0.2)
    doubtful = answer(A, B, wrong, (Alternative(np.eye(4), INFORMATION, 0.3), right))
    known = known_by(SOLUTION, [doubtful, *ANSWERS[1:]], CLOSE)
    chosen = known.measurements[0]
    assert np.array_equal(chosen.T_target_source, there(A, B))
    assert np.array_equal(chosen.information, INFORMATION * 2)
    assert chosen.alternatives == ()


def test_what_is_new_is_taken_as_it_is():
    new = [answer(E, A), answer(FragmentId("1", 2, 1), D, np.eye(4)), answer(D, A)]
    known = known_by(SOLUTION, [*ANSWERS, *new], CLOSE)
    assert all(any(m is each for m in known.measurements) for each in new)
    assert members(known) == [{A, B, C, D}]


def test_components_stay_apart_and_what_was_between_them_rejected():
    apart = solution(edge(A, B), edge(C, D), edge(B, C, accepted=False), component={C: 1, D: 1})
    known = known_by(apart, [*ANSWERS[:3], answer(B, E)], CLOSE)
    assert members(known) == [{A, B}, {C, D}]
    assert [m.pair for m, _ in known.rejected] == [FragmentPair(B, C)]
    assert pairs(known.measurements) == [(A, B), (C, D), (B, E)]


def test_an_excluded_answer_is_not_kept_and_the_rest_is():
    known = known_by(SOLUTION, [m for m in ANSWERS if m.pair != FragmentPair(A, B)], CLOSE)
    # Only the answer linked A with the others, so what submaps found in its light goes, too.
    assert members(known) == [{B, C, D}]
    assert pairs(known.measurements) == [(B, C), (C, D)]
    assert len(known.rejected) == 1


def test_what_an_excluded_answer_had_rejected_is_open_again():
    known = known_by(SOLUTION, [m for m in ANSWERS if m.pair != FragmentPair(C, D)], CLOSE)
    assert members(known) == [{A, B, C}]
    assert known.rejected == ()
    assert any(m is ANSWERS[3] for m in known.measurements)
    assert (A, C) in pairs(known.measurements)


def test_what_submaps_found_between_parts_without_answers_does_not_hang_on_these():
    by_submaps = solution(edge(A, B), edge(C, D), edge(B, C, EdgeKind.SUBMAP))
    assert members(known_by(by_submaps, [ANSWERS[0], ANSWERS[2]], CLOSE)) == [{A, B, C, D}]
    known = known_by(by_submaps, [ANSWERS[0]], CLOSE)
    assert members(known) == [{A, B, C}]


def test_a_constraint_that_agrees_changes_nothing():
    nearly = there(D, A) @ from_yaw(0.01, (0.1, 0.0, 0.0))
    manual = answer(D, A, nearly, manual=True)
    known = known_by(SOLUTION, [*ANSWERS, manual], CLOSE)
    assert members(known) == [{A, B, C, D}]
    assert any(m is manual for m in known.measurements)


@pytest.mark.parametrize("before", [False, True])
def test_what_constraints_contradict_is_forgotten(before):
    """Of the whole component: nobody knows what of it is wrong."""
    other = solution(edge(A, B), edge(C, D), component={C: 1, D: 1})
    answers = [ANSWERS[0], ANSWERS[2]]
    if before:  # a constraint that is gone or changed, not one that came
        manual = edge(A, B, EdgeKind.MANUAL)
        other = replace(other, edges=(*other.edges, manual))
        for now in ([], [answer(A, B, from_yaw(0.001, there(A, B)[:3, 3]), manual=True)]):
            known = known_by(other, [*answers, *now], CLOSE)
            assert members(known) == [{C, D}]
            assert any(m is answers[0] for m in known.measurements)
        same = answer(A, B, manual=True)
        assert members(known_by(other, [*answers, same], CLOSE)) == [{A, B}, {C, D}]
        return
    manual = answer(A, B, np.eye(4), manual=True)
    known = known_by(other, [*answers, manual], CLOSE)
    assert members(known) == [{C, D}]
    assert known.measurements[0] is answers[0]
    assert known.measurements[-1] is manual


def test_failures_and_nothing_are_no_trouble():
    failed = replace(edge(A, E, accepted=False), status=EdgeStatus.FAILED)
    assert known_by(solution(failed), [], CLOSE).measurements == ()
    empty = known_by(PoseGraph(), ANSWERS, CLOSE)
    assert (empty.parts, list(empty.measurements), empty.rejected) == ((), ANSWERS, ())


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2, 4, 6), *building.spots(2, 4, 5, 6)]


@pytest.fixture(scope="module")
def new(building):
    """Of the third stage."""
    return building.spots(3, 3, 4, 5)


@pytest.fixture(scope="module")
def synchronizer():
    return Submaps(MultiwayConfig())


@pytest.fixture(scope="module")
def answers(building, ids):
    """A third is wrong, of a third an alternative is right."""
    return [
        (
            building.wrong(pair, number, 0.6),
            building.right(pair, 0.8),
            building.wrong(pair, number, 0.5, 0.2),
        )[number % 3]
        for number, pair in enumerate(building.asked(ids))
    ]


@pytest.fixture(scope="module")
def settled(building, synchronizer, ids, answers):
    graph = synchronizer.synchronize_points(ids, answers, building.prepared)
    placed = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
    assert placed.keys() == set(ids)
    assert building.worst(placed)[0] < 0.1
    return graph


def decisions(graph, ids):
    return {
        (e.pair, e.kind): (e.status, e.T_target_source.tobytes())
        for e in graph.edges
        if {e.pair.source, e.pair.target} <= set(ids)
    }


def drift(one, other, ids):
    """Largest distance between the poses of two graphs, metres."""
    poses = [{id_: graph.poses()[id_].T_map_fragment for id_ in ids} for graph in (one, other)]
    return max(
        np.linalg.norm((relative(a[id_], a[ids[0]]) - relative(b[id_], b[ids[0]]))[:3, 3])
        for a, b in [poses]
        for id_ in ids
    )


def test_solved_again_it_is_the_same(synchronizer, settled, ids, answers):
    again = synchronizer.synchronize(ids, answers, settled)
    assert again.synchronizer == "submaps"
    assert decisions(again, ids) == decisions(settled, ids)
    assert EdgeKind.SUBMAP in {kind for _, kind in decisions(again, ids)}
    assert drift(again, settled, ids) < 0.01
    reasons = {e.pair: e.reason for e in settled.edges if e.status is EdgeStatus.REJECTED}
    assert reasons == {e.pair: e.reason for e in again.edges if e.status is EdgeStatus.REJECTED}


def test_a_new_stage_is_attached_and_the_map_stays(
    building, synchronizer, settled, ids, new, answers
):
    """Though a third of what comes is wrong."""
    fresh = [pair for pair in building.asked([*ids, *new]) if {pair.source, pair.target} & {*new}]
    further = [
        building.right(pair) if number % 3 else building.wrong(pair, number, 0.9)
        for number, pair in enumerate(fresh)
    ]
    graph = synchronizer.synchronize([*ids, *new], [*answers, *further], settled)
    assert decisions(graph, ids) == decisions(settled, ids)
    assert drift(graph, settled, ids) < 0.03
    placed = {
        id_: node.T_map_fragment for id_, node in graph.poses().items() if node.component == 0
    }
    assert placed.keys() >= {*ids, *new}
    assert building.worst(placed)[0] < 0.15


def test_a_constraint_wins_over_what_is_known(building, synchronizer, settled, ids, answers):
    pair = FragmentPair(ids[0], ids[-1])
    moved = building.truth(pair) @ from_yaw(0.5, (2.0, 1.0, 0.0))
    manual = Measurement(pair, moved, INFORMATION * 4, level=True, manual=True)
    graph = synchronizer.synchronize(ids, [*answers, manual], settled)
    poses = graph.poses()
    found = relative(poses[pair.source].T_map_fragment, poses[pair.target].T_map_fragment)
    assert np.allclose(found, moved, atol=0.05)
    (edge,) = (edge for edge in graph.edges if edge.kind is EdgeKind.MANUAL)
    assert edge.status is EdgeStatus.ACCEPTED


def test_what_is_known_does_not_depend_on_the_order(synchronizer, settled, ids, answers):
    one = synchronizer.synchronize(ids, answers, settled)
    turned = replace(settled, nodes=settled.nodes[::-1], edges=settled.edges[::-1])
    other = synchronizer.synchronize(ids[::-1], answers[::-1], turned)
    assert decisions(one, ids) == decisions(other, ids)
    for node, again in zip(one.nodes, other.nodes, strict=True):
        assert np.array_equal(node.T_map_fragment, again.T_map_fragment)
