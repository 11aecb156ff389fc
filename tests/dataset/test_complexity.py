import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nss_ros.dataset import complexity
from nss_ros.dataset.complexity import geometric_complexity, surface_variation
from nss_ros.errors import InputError
from nss_ros.geometry import exponential, transform_points

seeds = st.integers(0, 2**32 - 1)


def cloud(seed, count=150):
    """Points on a bent sheet and scattered around it, with duplicates, about 3 m across."""
    rng = np.random.default_rng(seed)
    sheet = rng.uniform(-1.5, 1.5, (count, 3))
    sheet[:, 2] = np.abs(sheet[:, 0]) * 0.7
    return np.concatenate((sheet, rng.uniform(-1.5, 1.5, (count // 3, 3)), sheet[:5]))


def brute_force(points, radius):
    variation = []
    for point in points:
        near = points[np.linalg.norm(points - point, axis=1) <= radius]
        eigenvalues = np.linalg.eigvalsh(np.cov(near.T, bias=True)) if len(near) > 1 else [0, 0, 0]
        total = np.sum(eigenvalues)
        variation.append(max(eigenvalues[0], 0) / total if total > 1e-14 else 0.0)
    return np.array(variation)


@settings(max_examples=25)
@given(seeds, st.floats(0.1, 5.0))
def test_it_equals_brute_force(seed, radius):
    points = cloud(seed)
    np.testing.assert_allclose(
        surface_variation(points, radius), brute_force(points, radius), atol=1e-9
    )
    assert geometric_complexity(points, radius) == pytest.approx(
        brute_force(points, radius).mean(), abs=1e-9
    )


@settings(max_examples=25)
@given(seeds)
def test_a_rigid_motion_and_the_order_of_the_points_change_nothing(seed):
    points = cloud(seed)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(points))
    moved = transform_points(exponential([*rng.uniform(-100, 100, 3), *rng.normal(size=3)]), points)
    np.testing.assert_allclose(
        surface_variation(moved[order]), surface_variation(points)[order], atol=1e-9
    )


def test_repeating_every_point_changes_nothing():
    points = cloud(7)
    twice = surface_variation(np.repeat(points, 2, axis=0))
    np.testing.assert_allclose(twice[::2], surface_variation(points), atol=1e-12)


def test_a_point_far_off_changes_nothing_for_the_others():
    points = cloud(11)
    far = surface_variation(np.concatenate((points, [[2000.0, -3000, 1000]])))
    np.testing.assert_allclose(far[:-1], surface_variation(points), atol=1e-9)
    assert far[-1] == 0


def test_a_plane_has_none_and_a_full_ball_has_all():
    rng = np.random.default_rng(0)
    plane = np.column_stack((rng.uniform(-1, 1, (500, 2)), np.zeros(500)))
    tilted = transform_points(exponential([1, 2, 3, 0.3, 0.2, 0.1]), plane)
    assert geometric_complexity(tilted) == pytest.approx(0.0, abs=1e-12)
    octahedron = np.concatenate((np.eye(3), -np.eye(3))) * 0.2
    np.testing.assert_allclose(surface_variation(octahedron, 1.0), 1 / 3)


def test_a_point_at_just_the_radius_counts():
    corner = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]])
    assert surface_variation(corner)[0] > 0
    assert surface_variation(corner, 0.499)[0] == 0


@pytest.mark.parametrize(
    "points", [np.zeros((1, 3)), np.ones((4, 3)), np.array([[0.0, 0, 0], [9, 9, 9]])]
)
def test_where_nothing_spreads_there_is_no_variation(points):
    np.testing.assert_array_equal(surface_variation(points), 0.0)


def test_an_empty_cloud_has_no_complexity():
    assert len(surface_variation(np.zeros((0, 3)))) == 0
    assert np.isnan(geometric_complexity(np.zeros((0, 3))))


def test_crowded_neighbourhoods_are_taken_piece_by_piece(monkeypatch):
    points = cloud(3)
    whole = surface_variation(points)
    monkeypatch.setattr(complexity, "_DISTANCES_AT_ONCE", 100)
    np.testing.assert_allclose(surface_variation(points), whole, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "radius", "words"),
    [
        (np.array([[0.0, 0, np.nan], [0, np.inf, 0], [0, 0, 0]]), 0.5, "2 points that are not fin"),
        (np.zeros((3, 2)), 0.5, r"shape \(n, 3\), not \(3, 2\)"),
        (np.zeros((3, 3)), 0.0, "must be positive, not 0.0 m"),
        (np.array([[0.0, 0, 0], [1e9, 1e9, 1e9]]), 0.001, "remove points that are far off"),
    ],
)
def test_what_cannot_be_measured_is_said(points, radius, words):
    with pytest.raises(InputError, match=words):
        surface_variation(points, radius)
