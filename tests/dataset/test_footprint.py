import numpy as np
import pytest

from nss_ros.dataset.footprint import floor_area
from nss_ros.geometry import from_yaw, inverse, transform_points

EMPTY = np.zeros((0, 3), dtype=np.float32)


def walls(width, depth, height=2.0):
    """Points on the walls of a room around the origin, map frame."""
    x, y = np.arange(-width / 2, width / 2, 0.05), np.arange(-depth / 2, depth / 2, 0.05)
    sides = [np.column_stack((x, np.full_like(x, side * depth / 2))) for side in (-1, 1)]
    sides += [np.column_stack((np.full_like(y, side * width / 2), y)) for side in (-1, 1)]
    plan = np.concatenate(sides)
    return np.column_stack((plan, np.full(len(plan), height)))


def seen_from(points, x, y, yaw=0.3):
    pose = from_yaw(yaw, (x, y, 1.6))
    return transform_points(inverse(pose), points).astype(np.float32), pose


def test_a_room_counts_as_far_as_its_walls_without_points_on_the_floor():
    assert floor_area([seen_from(walls(6, 4), 0.5, -0.7)]) == pytest.approx(24, rel=0.03)


def test_what_two_fragments_see_counts_once():
    one, other = seen_from(walls(6, 4), 0.5, -0.7), seen_from(walls(6, 4), -2.0, 1.0, yaw=2.0)
    assert floor_area([one, other]) == pytest.approx(floor_area([one]), rel=0.03)
    far = other[0], from_yaw(2.0, (98.0, 1.0, 1.6))
    assert floor_area([one, far]) == pytest.approx(2 * floor_area([one]), rel=0.05)


def test_nothing_is_seen_behind_a_wall():
    behind = np.array([(50.0, 0.0, 1.0)])
    room = walls(6, 4)
    hidden = room[~((room[:, 0] > 2.9) & (np.abs(room[:, 1]) < 0.05))]  # a slit in the wall
    alone = floor_area([seen_from(room, 0, 0)])
    through = floor_area([seen_from(np.concatenate((hidden, behind)), 0, 0)])
    # A sector of three degrees that gets wider, not a half plane of 50 m.
    assert 0 < through - alone < 0.5 * np.radians(3) * 50**2 * 1.2


def test_negative_and_large_coordinates_are_cells_like_others():
    base = floor_area([seen_from(walls(6, 4), 0, 0)])
    points, _ = seen_from(walls(6, 4), 0, 0)
    for place in ((-1000.0, 5e5, 0.0), (7.25, -31.5, 20.0)):
        assert floor_area([(points, from_yaw(0.3, place))]) == pytest.approx(base, rel=0.03)


def test_without_points_there_is_no_floor():
    assert floor_area([]) == 0
    assert floor_area([(EMPTY, np.eye(4))]) == 0
