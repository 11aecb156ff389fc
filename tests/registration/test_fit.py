"""How well walls lie on each other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.geometry import exponential, from_yaw, inverse
from nss_ros.icp import Surface
from nss_ros.registration.fit import fit


def wall(facing=1.0):
    """Two square metres of a wall of the plane x = 2, and as much floor."""
    grid = np.stack(np.meshgrid(np.arange(0, 2, 0.05), np.arange(0, 1, 0.05)), -1).reshape(-1, 2)
    points = np.vstack((np.insert(grid, 0, 2.0, axis=1), np.insert(grid, 2, -1.5, axis=1)))
    normals = np.repeat([[-facing, 0, 0], [0, 0, 1.0]], len(grid), axis=0)
    return Surface.of(points, normals)


def moved(surface, transform):
    points = surface.points @ transform[:3, :3].T + transform[:3, 3]
    return Surface.of(points, surface.normals @ transform[:3, :3].T)


def test_walls_on_each_other_fit_and_floors_do_not_count():
    assert fit(wall(), wall(), np.eye(4), 0.15) == pytest.approx(0.5)
    assert fit(wall(), wall(facing=-1.0), np.eye(4), 0.15) == 0
    assert fit(wall(), wall(), from_yaw(0, (9, 0, 0)), 0.15) == 0


def test_a_wall_that_is_centimetres_off_fits_less():
    shares = [fit(wall(), wall(), from_yaw(0, (x, 0, 0)), 0.15) for x in (0, 0.01, 0.03, 0.1, 0.2)]
    assert shares == sorted(shares, reverse=True)
    assert shares[2] == pytest.approx(0.5 / 4, rel=0.02)
    assert shares[-1] == 0


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-5, 5))
def test_the_frame_does_not_matter(yaw, angle, x):
    """Of the source any, of the target one that is level."""
    source = exponential([x, 1, 2, 0.3, angle, 0.1])
    target = from_yaw(yaw, (x, -2, 1))
    near = from_yaw(0.02, (0.01, 0.02, 0))
    there = target @ near @ inverse(source)
    share = fit(moved(wall(), source), moved(wall(), target), there, 0.15)
    assert share == pytest.approx(fit(wall(), wall(), near, 0.15), abs=0.01)
