"""Measurements that nobody asked for, or that were wrong, made from where a submap puts them."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import FragmentPair
from nss_ros.geometry import from_yaw, tilt_angle
from nss_ros.multiway.closures import SUBMAP_CONFIDENCE, closures, decided
from nss_ros.multiway.pose_graph import EdgeKind
from nss_ros.multiway.spanning_tree import components

CONFIG = RegistrationConfig()
ENOUGH = 6


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2, 4, 6), *building.spots(2, 4, 5)]


@pytest.fixture(scope="module")
def part(building, ids):
    return building.part(ids)


@pytest.fixture(scope="module")
def found(building, part):
    return closures(part, [], building.prepared, CONFIG)


def degrees_of(measurements):
    return Counter(end for m in measurements for end in (m.pair.source, m.pair.target))


def test_closures_lie_near_the_truth(building, found):
    errors = [building.error(m.T_target_source, m.pair.source, m.pair.target) for m in found]
    assert max(distance for distance, _ in errors) < 0.1
    assert max(angle for _, angle in errors) < 1.5


def test_closures_link_every_fragment(found, ids):
    assert len(components(ids, found)) == 1


def test_closures_are_measurements_of_submaps(found):
    assert len({frozenset((m.pair.source, m.pair.target)) for m in found}) == len(found)
    for m in found:
        assert m.kind is EdgeKind.SUBMAP
        assert m.pair.source < m.pair.target
        assert m.confidence == SUBMAP_CONFIDENCE
        assert m.level
        assert not m.manual
        assert not m.alternatives
        assert m.inliers > 100
        assert np.degrees(tilt_angle(m.T_target_source)) < 3
        assert np.linalg.eigvalsh(m.information)[0] > 0


def test_poses_that_are_a_little_wrong_are_mended(building, part):
    random = np.random.default_rng(0)
    moved = {
        id_: pose @ from_yaw(random.normal(0, 0.01), random.normal(0, 0.03, 3))
        for id_, pose in part.items()
    }
    found = closures(moved, [], building.prepared, CONFIG)
    errors = [building.error(m.T_target_source, m.pair.source, m.pair.target) for m in found]
    assert np.median([distance for distance, _ in errors]) < 0.04
    assert max(distance for distance, _ in errors) < 0.15


def test_fragments_with_enough_edges_get_none(building, ids):
    ids = [*ids, *building.spots(2, 6)]
    part = building.part(ids)
    accepted = [building.right(FragmentPair(*pair)) for pair in combinations(ids, 2)]
    assert min(degrees_of(accepted).values()) >= ENOUGH
    assert closures(part, accepted, building.prepared, CONFIG) == []
    # Without the edges of one fragment, only that one gets some.
    lone = ids[0]
    others = [m for m in accepted if lone not in (m.pair.source, m.pair.target)]
    found = closures(part, others, building.prepared, CONFIG)
    assert 1 <= len(found) <= ENOUGH
    assert all(lone in (m.pair.source, m.pair.target) for m in found)


def test_pairs_that_are_measured_are_not_measured_again(building, part, found):
    for turned in (False, True):
        ends = [(m.pair.source, m.pair.target)[:: -1 if turned else 1] for m in found[:4]]
        accepted = [building.right(FragmentPair(*each)) for each in ends]
        again = closures(part, accepted, building.prepared, CONFIG)
        pairs = {frozenset((m.pair.source, m.pair.target)) for m in again}
        assert not pairs & {frozenset(each) for each in ends}


def test_fragments_that_hardly_overlap_are_linked_where_nothing_else_does(building):
    hardly, between = building.spots(2, 3, 6), building.spots(2, 4)[0]
    pair = FragmentPair(*hardly)
    (found,) = closures(building.part(hardly), [], building.prepared, CONFIG)
    assert found.pair == pair
    distance, angle = building.error(found.T_target_source, pair.source, pair.target)
    assert distance < 0.2
    assert angle < 3
    linked = [building.right(FragmentPair(each, between)) for each in hardly]
    found = closures(building.part([*hardly, between]), linked, building.prepared, CONFIG)
    assert pair not in [m.pair for m in found]


def test_fragments_far_from_each_other_are_not_linked(building):
    ids = building.spots(3, 6, 7)
    assert closures(building.part(ids), [], building.prepared, CONFIG) == []


def test_one_fragment_needs_no_closure(building, ids):
    assert closures({ids[0]: np.eye(4)}, [], building.prepared, CONFIG) == []


def test_the_order_of_the_poses_does_not_matter(building, part, found):
    again = closures(dict(reversed(part.items())), [], building.prepared, CONFIG)
    assert [m.pair for m in again] == [m.pair for m in found]
    for one, other in zip(again, found, strict=True):
        assert one.T_target_source.tobytes() == other.T_target_source.tobytes()
        assert one.information.tobytes() == other.information.tobytes()


def test_what_is_decided_is_no_longer_spread_over_other_hypotheses(building, ids):
    pair = FragmentPair(ids[0], ids[1])
    slid = np.diag([1 / 0.5**2, 1e4, 1e4, 1e5, 1e5, 1e5])
    ambiguous = replace(building.right(pair), information=slid)
    by_hand = replace(ambiguous, manual=True)
    sure, kept = decided([ambiguous, by_hand], building.prepared, CONFIG)
    assert kept is by_hand
    assert sure.T_target_source is ambiguous.T_target_source
    assert sure.confidence == ambiguous.confidence
    deviations = np.sqrt(np.diag(np.linalg.inv(sure.information)))
    assert deviations[:3].max() < 0.05
    assert np.degrees(deviations[3:].max()) < 0.5
