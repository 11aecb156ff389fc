"""Fragments that slid a few decimetres go back to where they fit all others."""

import numpy as np
import pytest

from nss_ros.geometry import from_yaw
from nss_ros.multiway.settling import settled


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2, 4, 6, 7), *building.spots(2, 4, 5, 6)]


def slid(part, ids, move):
    """Poses of which some have moved together."""
    return {id_: move @ pose if id_ in ids else pose for id_, pose in part.items()}


def errors(poses, truth, anchor):
    """Distance of each pose from the true one, in the frame of a fragment that stayed, metres."""
    frame = truth[anchor] @ np.linalg.inv(poses[anchor])
    return {id_: np.linalg.norm((frame @ poses[id_] - truth[id_])[:3, 3]) for id_ in poses}


@pytest.mark.parametrize(("number", "move"), [(1, (0.3, 0.0)), (3, (0.0, -0.3)), (6, (-0.1, 0.25))])
def test_one_that_slid_goes_back(building, ids, number, move):
    truth = building.part(ids)
    start = slid(truth, {ids[number]}, from_yaw(0.01, (*move, 0)))
    found = errors(settled(start, building.prepared), truth, ids[0])
    assert errors(start, truth, ids[0])[ids[number]] > 0.25
    assert max(found.values()) < 0.1


def test_those_of_a_stage_that_slid_together_go_back(building, ids):
    truth = building.part(ids)
    later = {id_ for id_ in ids if id_.stage == 2}
    start = slid(truth, later, from_yaw(0.0, (0.25, -0.15, 0)))
    found = errors(settled(start, building.prepared), truth, ids[0])
    assert min(errors(start, truth, ids[0])[id_] for id_ in later) > 0.25
    assert max(found.values()) < 0.12


def test_those_that_are_right_stay_about_there(building, ids):
    truth = building.part(ids)
    found = errors(settled(truth, building.prepared), truth, ids[0])
    assert max(found.values()) < 0.1
    assert sum(error == 0 for error in found.values()) > len(ids) / 2


def test_what_a_person_placed_stays(building, ids):
    held = ids[3]
    start = slid(building.part(ids), {held}, from_yaw(0.0, (0.3, 0.1, 0)))
    found = settled(start, building.prepared, {held})
    assert np.array_equal(found[held], start[held])


def test_another_place_is_not_looked_for(building, ids):
    """What is metres off is the business of the joining; what nobody sees stays."""
    alone = ids[2]
    for move in ((2.5, 1.5, 0), (60, 0, 0)):
        start = slid(building.part(ids), {alone}, from_yaw(0.0, move))
        found = settled(start, building.prepared)
        assert np.linalg.norm((found[alone] - start[alone])[:3, 3]) < 0.6 * 3
    assert np.array_equal(found[alone], start[alone])


def test_the_same_comes_again_whatever_the_order(building, ids):
    start = slid(building.part(ids), {ids[1], ids[6]}, from_yaw(0.0, (0.2, 0.2, 0)))
    one = settled(start, building.prepared)
    other = settled(dict(reversed(start.items())), building.prepared)
    assert all(np.array_equal(one[id_], other[id_]) for id_ in ids)


def test_one_fragment_has_nothing_to_fit(building, ids):
    part = building.part(ids[:1])
    assert settled(part, building.prepared).keys() == part.keys()
