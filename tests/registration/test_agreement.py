"""What two scanners of one stage see of each other's walls, in rooms that are nearly alike."""

import numpy as np
import pytest

from nss_ros.geometry import from_yaw, inverse
from nss_ros.registration.gravity.agreement import SharpView, WallView, agreement, contradiction

# Shares of the walls that the noise of the sensor may put before a surface.
NO_CONFLICT, NO_CONTRADICTION = 0.012, 0.004
HALF = np.array([2.5, 2.0])
STEP = 0.05


def room(rng, panel=None):
    """Walls (n, 3) of a room about the sensor with its normals, and a panel on one of them."""
    heights = np.arange(-1.5, 1.2, STEP)
    points, normals = [], []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        along = np.arange(-HALF[1 - axis], HALF[1 - axis], STEP)
        u, z = (each.ravel() for each in np.meshgrid(along, heights))
        depth = np.full(len(u), HALF[axis])
        if axis == 0 and sign == 1 and panel is not None:
            place, thickness = panel
            depth[(np.abs(u - place) < 0.5) & (z < 0)] -= thickness
        wall = np.zeros((len(u), 3))
        wall[:, axis], wall[:, 1 - axis], wall[:, 2] = sign * depth, u, z
        points.append(wall)
        normals.append(np.tile(-sign * np.eye(3)[axis], (len(u), 1)))
    cloud = np.concatenate(points)
    return cloud + rng.normal(0, 0.01, cloud.shape), np.concatenate(normals)


def conflict(one, other):
    return agreement(WallView.of(*one), WallView.of(*other), np.eye(4)).conflict


def contradicted(one, other, transform=None):
    there = np.eye(4) if transform is None else transform
    return contradiction(SharpView.of(*one), SharpView.of(*other), there)


def test_scans_of_one_room_do_not_contradict_each_other():
    rng = np.random.default_rng(0)
    one, other = room(rng, (0.7, 0.2)), room(rng, (0.7, 0.2))
    assert conflict(one, other) < NO_CONFLICT
    assert contradicted(one, other).share < NO_CONTRADICTION
    assert contradicted(one, other).shared > 0.9


def test_what_stands_elsewhere_in_a_room_that_is_alike_is_seen_by_sharp_views_only():
    rng = np.random.default_rng(1)
    one, other = room(rng, (0.7, 0.2)), room(rng, (-0.6, 0.2))
    assert conflict(one, other) < NO_CONFLICT
    assert contradicted(one, other).share > 4 * NO_CONTRADICTION


def test_a_thing_contradicts_and_what_a_scanner_looks_past_does_not():
    """A panel that only one scanner has points of; then it is 3 m behind a wall."""
    rng = np.random.default_rng(2)
    points, normals = room(rng)
    panel = rng.uniform((1.0, -0.5, -1), (1.02, 0.5, 1), (1000, 3))
    face = np.tile((-1.0, 0.0, 0.0), (1000, 1))
    with_panel = np.vstack((points, panel)), np.vstack((normals, face))
    seen = contradicted(with_panel, (points, normals))
    assert seen.solid > 0.8 * seen.free
    assert seen.share > 2 * NO_CONTRADICTION
    behind = panel + np.array((3.0, 0.0, 0.0))
    with_more = np.vstack((points, behind)), np.vstack((normals, face))
    assert contradicted(with_more, (points, normals)).solid == 0


def test_single_points_in_free_space_are_no_thing():
    rng = np.random.default_rng(3)
    points, normals = room(rng)
    stray = rng.uniform((-1.5, -1.2, -1), (1.5, 1.2, 1), (60, 3))
    with_stray = np.vstack((points, stray)), np.vstack((normals, np.tile((1.0, 0, 0), (60, 1))))
    seen = contradicted(with_stray, (points, normals))
    assert seen.free > 0
    assert seen.solid < seen.free / 4


def test_both_fragments_count_alike():
    rng = np.random.default_rng(4)
    one, other, there = room(rng, (0.7, 0.2)), room(rng), from_yaw(0.4, (0.3, -0.2, 0.0))
    forth, back = contradicted(one, other, there), contradicted(other, one, inverse(there))
    assert forth.share == pytest.approx(back.share)
    assert forth.free == pytest.approx(back.free)


def test_without_walls_nothing_is_contradicted():
    floor = np.column_stack((np.random.default_rng(5).uniform(-2, 2, (500, 2)), np.full(500, -1.5)))
    level = np.tile((0.0, 0.0, 1.0), (500, 1))
    assert contradicted((floor, level), (floor, level)).share == 0
