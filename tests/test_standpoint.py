"""Where scanners stood: fragments of the bundled bag, in their own frames and in others."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nss_ros.bag import read_log
from nss_ros.carrier import without_carrier
from nss_ros.fragment import Fragment
from nss_ros.geometry import (
    adjoint,
    exponential,
    from_yaw,
    inverse,
    logarithm,
    rotation_angle,
    transform_points,
)
from nss_ros.standpoint import Standpoints, at_standpoint, is_origin, shift, standpoint

BAG = Path(__file__).parents[1] / "bags" / "three_stages"
places = st.tuples(*(st.floats(-30, 30) for _ in range(3))).map(np.array)


@pytest.fixture(scope="module")
def scans():
    return list(read_log(BAG).fragments.values())


def test_a_sensor_frame_stays_as_it_is(scans):
    for fragment in scans:
        seen, place = at_standpoint(fragment)
        assert np.array_equal(seen.points, without_carrier(fragment.points))
        assert is_origin(place)


def test_of_an_origin_on_the_floor_the_scanner_stood_above_it(scans):
    for fragment in scans[::4]:
        foot = np.array([0.0, 0.0, 1.6])
        place = standpoint(fragment.points + foot)
        assert np.hypot(*place[:2]) < 0.5
        assert abs(place[2] - 1.6) < 0.3


@pytest.mark.parametrize("origin", [(14.0, -9.0, 4.0), (-6.0, 3.0, 11.0), (160.0, 75.0, -20.0)])
def test_in_the_frame_of_a_site_it_is_found_again(scans, origin):
    errors = [standpoint(each.points + np.array(origin)) - origin for each in scans[::6]]
    distances = np.linalg.norm(errors, axis=1)
    assert np.median(distances) < 0.3
    assert distances.max() < 0.8


def test_a_fragment_is_then_seen_from_there(scans):
    far = np.array([40.0, -25.0, 3.0])
    moved = Fragment(scans[0].id, (scans[0].points + far).astype(np.float32), True)
    seen, place = at_standpoint(moved)
    assert np.linalg.norm(place[:3, 3] - far) < 0.8
    assert np.allclose(seen.points + place[:3, 3], moved.points, atol=1e-4)
    assert (seen.id, seen.gravity_aligned) == (moved.id, True)


def test_what_is_not_levelled_has_no_standpoint(scans):
    moved = Fragment(scans[0].id, scans[0].points + np.float32(50), False)
    seen, place = at_standpoint(moved)
    assert seen is moved
    assert is_origin(place)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.full((1, 3), 50.0),
        np.full((300, 3), np.nan),
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e9]]),
        np.linspace(0, 8, 500)[:, None] * np.array([[1.0, 0.3, 0.1]]) + 20,
        np.random.default_rng(0).uniform(5, 11, (3000, 3)) * np.array([1, 1, 0]),
    ],
    ids=["none", "one", "not finite", "two far ones", "a line", "a plane"],
)
def test_what_says_nothing_gives_a_finite_place(points):
    place = standpoint(points.astype(np.float32))
    assert place.shape == (3,)
    assert np.isfinite(place).all()


@pytest.mark.parametrize("degrees", [3.0, 4.5])
def test_a_tilted_scanner_is_set_upright(scans, degrees):
    for number, fragment in enumerate(scans[::5]):
        turn = Rotation.from_rotvec(np.radians(degrees) * np.array([np.cos(number), 0.6, 0]))
        tilted = Fragment(
            fragment.id, (fragment.points @ turn.as_matrix()).astype(np.float32), True
        )
        seen, place = at_standpoint(tilted)
        # What carries the scanner is told when it is upright.
        assert np.allclose(
            seen.points, without_carrier(transform_points(inverse(place), tilted.points)), atol=1e-5
        )
        assert np.allclose(place[:3, 3], 0)
        left = turn.as_matrix() @ place[:3, :3]
        # Tripods are up to 1.4 degrees off themselves.
        assert np.degrees(np.arccos(left[2, 2])) < 1.7
        assert np.degrees(rotation_angle(place)) < 1.3 * degrees + 1.5


def test_ground_that_slopes_beneath_upright_walls_is_no_tilt(scans):
    """The floor and the ceiling slope by four degrees, the walls do not."""
    for fragment in scans[::5]:
        points = fragment.points.copy()
        points[:, 2] += np.float32(np.tan(np.radians(4))) * points[:, 0]
        assert is_origin(at_standpoint(Fragment(fragment.id, points, True))[1])


def test_tilts_are_left_on_request(scans):
    turn = Rotation.from_euler("x", 3, degrees=True)
    tilted = Fragment(scans[0].id, (scans[0].points @ turn.as_matrix()).astype(np.float32), True)
    assert not is_origin(at_standpoint(tilted)[1])
    assert is_origin(at_standpoint(tilted, search=False)[1])


frames = st.builds(
    lambda twist, place: shift(place) @ exponential(np.r_[np.zeros(3), twist]),
    st.tuples(*(st.floats(-0.1, 0.1) for _ in range(3))),
    places,
)


@given(frames, frames, st.floats(-3, 3), places)
def test_transforms_between_standpoints_and_frames(source, target, yaw, translation):
    ends = Standpoints(source, target)
    transform = from_yaw(yaw, translation)
    assert np.allclose(ends.transform(transform), target @ transform @ inverse(source), atol=1e-9)
    back = Standpoints(inverse(source), inverse(target))
    assert np.allclose(back.transform(ends.transform(transform)), transform, atol=1e-9)


@given(frames, frames, st.integers(0, 1000))
def test_a_covariance_is_that_of_the_moved_error(source, target, seed):
    ends, twist = Standpoints(source, target), np.random.default_rng(seed).normal(0, 0.01, 6)
    transform = from_yaw(0.3, (1.0, 2.0, 0.1))
    moved = ends.transform(exponential(twist) @ transform) @ inverse(ends.transform(transform))
    there = logarithm(moved)
    assert np.allclose(there, adjoint(target) @ twist, atol=1e-9)
    assert np.allclose(ends.covariance(np.outer(twist, twist)), np.outer(there, there), atol=1e-9)
