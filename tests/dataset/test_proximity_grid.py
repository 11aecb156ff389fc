import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nss_ros.dataset.proximity_grid import FAR, MET, NEAR, proximity_grid
from nss_ros.geometry import exponential, transform_points


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 0.6))
def test_what_is_sure_is_true(seed, distance):
    rng = np.random.default_rng(seed)
    points, positions = rng.uniform(-1, 1, (200, 3)), rng.uniform(-1.6, 1.6, (2000, 3))
    T_cloud_source = exponential(rng.normal(0, 0.3, 6))
    moved = transform_points(T_cloud_source, positions)
    least = np.linalg.norm(moved[:, None] - points[None], axis=2).min(axis=1)
    grid = proximity_grid(points.T, distance)
    labels = grid.at(T_cloud_source, np.ascontiguousarray(positions.T))
    assert (least[labels == MET] <= distance).all()
    assert (least[labels == FAR] > distance).all()
    assert set(np.unique(labels)) <= {FAR, NEAR, MET}


def test_most_positions_on_and_off_a_surface_are_decided():
    rng = np.random.default_rng(0)
    wall = np.column_stack((rng.uniform(0, 2, (4000, 2)), np.zeros(4000)))
    grid = proximity_grid(wall.T, 0.2)
    inner = np.column_stack((rng.uniform(0.3, 1.7, (500, 2)), np.zeros(500)))
    heights = {0.0: MET, 0.05: MET, 0.4: FAR, 3.0: FAR, 1e6: FAR}
    for height, label in heights.items():
        labels = grid.at(np.eye(4), np.add(inner, (0, 0, height)).T)
        assert (labels == label).mean() > 0.95, height


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.array([[0.0, 0, 0], [1e7, 1e7, 1e7]])])
def test_there_is_no_grid_of_nothing_or_of_almost_nothing(points):
    assert proximity_grid(points.T, 0.2) is None
