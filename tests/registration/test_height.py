"""Heights of rooms whose floors and ceilings come and go."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.geometry import from_yaw, inverse, transform_points
from nss_ros.registration.gravity.height import Levels, height_between

DOWN, UP = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)


def sheet(x0, x1, y0, y1, z, normal, spacing=0.1):
    """Points and normals of a level rectangle, heights above the structural floor."""
    x, y = np.meshgrid(np.arange(x0, x1, spacing), np.arange(y0, y1, spacing))
    points = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, z)))
    return points, np.tile(normal, (len(points), 1))


def room(floor=0.0, ceiling=3.0, shelves=True):
    """A room of which the scanner sees more of the ceiling than of the floor."""
    sheets = [sheet(-1.5, 1.5, -2, 2, floor, UP), sheet(-3, 3, -3, 3, ceiling, DOWN)]
    if shelves:  # of the structure, and seen at all times
        sheets += [sheet(2.6, 3, -3, 3, 0.9, UP), sheet(2.6, 3, -3, 3, 2.1, DOWN)]
    points, normals = zip(*sheets, strict=True)
    return np.concatenate(points), np.concatenate(normals)


def levels(surfaces, floor=0.0, T_map_sensor=None):
    pose = from_yaw(0.0, (0, 0, 1.6)) if T_map_sensor is None else T_map_sensor
    points, normals = surfaces
    back = inverse(pose)
    turned = normals @ back[:3, :3].T
    return Levels.of(transform_points(back, points), turned, floor - pose[2, 3])


@given(st.floats(-3, 3), st.floats(1.3, 2.1), st.floats(-1, 1))
def test_the_height_of_the_same_room_is_that_of_the_sensors(yaw, height, x):
    target_pose, source_pose = from_yaw(0.0, (0, 0, 1.6)), from_yaw(yaw, (x, 0.3, height))
    source, target = levels(room(), 0.0, source_pose), levels(room(), 0.0, target_pose)
    truth = inverse(target_pose) @ source_pose
    assert height_between(source, target, truth) == pytest.approx(height - 1.6, abs=0.03)


@pytest.mark.parametrize("drop", [0.1, 0.2, 0.3, 0.35, 0.6])
def test_a_ceiling_that_came_down_does_not_lift_the_floor(drop):
    # The larger surface moved, and a vote by points would follow it.
    before, after = levels(room(shelves=False)), levels(room(ceiling=3.0 - drop, shelves=False))
    for source, target in ((before, after), (after, before)):
        assert height_between(source, target, np.eye(4)) == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("rise", [0.1, 0.2, 0.3])
def test_a_raised_floor_is_told_by_what_stayed(rise):
    before, after = levels(room()), levels(room(floor=rise), rise)
    assert height_between(before, after, np.eye(4)) == pytest.approx(0.0, abs=0.03)
    assert height_between(after, before, np.eye(4)) == pytest.approx(0.0, abs=0.03)


def test_without_level_surfaces_the_floors_decide():
    walls = (np.random.default_rng(0).uniform(-2, 2, (500, 3)), np.tile((1.0, 0, 0), (500, 1)))
    source, target = levels(walls, 0.2), levels(walls, -0.1)
    assert height_between(source, target, np.eye(4)) == pytest.approx(-0.3)
    assert height_between(levels(room()), target, np.eye(4)) == pytest.approx(-0.1)


def test_fragments_that_share_no_place_are_left_to_the_floors():
    far = from_yaw(0.0, (50, 0, 0))
    source, target = levels(room(), 0.0), levels(room(floor=0.5), 0.5)
    assert height_between(source, target, far) == pytest.approx(0.5)
