"""Tripods of one stage that stand on the same place, by the bundled bag."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw, inverse
from nss_ros.multiway.spacing import count_on_same_place, loss_on_same_place, on_same_place
from nss_ros.multiway.spanning_tree import Closeness
from nss_ros.multiway.submap import register_submaps


def at(distance, angle=0.0):
    return from_yaw(0.4, (distance * np.cos(angle), distance * np.sin(angle), 0.1))


def part(stage, *places):
    return {FragmentId("1", stage, n): from_yaw(n, (*each, 0)) for n, each in enumerate(places)}


def test_tripods_of_the_bundled_bag_stand_apart(building):
    within = [building.truth(pair) for pair in building.pairs if pair.same_stage]
    assert not any(on_same_place(each) for each in within)
    assert loss_on_same_place(within) > 0


def test_a_place_is_held_against_a_pair_unless_pairs_are_often_there():
    apart = [at(distance, distance) for distance in np.linspace(1, 4, 60)]
    assert loss_on_same_place([]) == loss_on_same_place(apart) > 0
    # One in 60 is an error, five are how this stage was scanned.
    assert loss_on_same_place([*apart, at(0.3)]) > 0
    assert loss_on_same_place([*apart, *[at(0.3)] * 5]) == 0
    assert loss_on_same_place([at(0.2)]) == 0


def test_what_is_far_away_says_nothing_about_the_share():
    assert loss_on_same_place([at(0.2), *[at(9.0)] * 1000]) == 0


def test_fragments_of_one_stage_on_one_place_are_counted():
    one, other = part(1, (0, 0), (2, 0), (4, 0)), part(1, (0, 0), (2, 0), (9, 9))
    assert count_on_same_place(one, other, np.eye(4)) == 2
    assert count_on_same_place(one, other, from_yaw(0, (0, 1, 0))) == 0
    assert count_on_same_place(one, other, from_yaw(np.pi, (2, 0.5, 0))) == 2
    assert count_on_same_place(one, part(2, (0, 0), (2, 0)), np.eye(4)) == 0


def test_storeys_above_each_other_are_not_one_place():
    one = part(1, (0, 0), (2, 0))
    assert count_on_same_place(one, one, from_yaw(0, (0, 0, 3))) == 0


@given(st.floats(-np.pi, np.pi), st.floats(-3, 3), st.floats(-3, 3))
def test_both_parts_count_alike(yaw, x, y):
    one, other = part(1, (0, 0), (2, 0), (4, 0.5)), part(1, (1, 1), (0, 3))
    link = from_yaw(yaw, (x, y, 0.0))
    gaps = [
        np.linalg.norm((link @ b)[:3, 3] - a[:3, 3]) for a in one.values() for b in other.values()
    ]
    assume(not np.isclose(gaps, 0.8).any())
    assert count_on_same_place(one, other, link) == count_on_same_place(other, one, inverse(link))


def test_a_like_room_that_is_taken_is_not_taken_again(building):
    """A submap on the place of others of its stage scores less by each that stands there."""
    ids = building.spots(1, 1, 2, 4, 6, 7)
    whole, again = building.submap(ids), building.submap(ids[:3])
    close = Closeness(0.4, np.radians(6))
    odds = [
        register_submaps(again, whole, [], close, same_place_loss=each).odds for each in (0.0, 3.0)
    ]
    assert odds[1] == pytest.approx(odds[0] - 9.0, abs=3.0)
