import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from nss_ros.benchmark.metrics import (
    correspondences,
    f1_score,
    pairwise_rmse,
    recall,
    rmse,
    rotation_error,
    squared_displacement,
    successes,
    translation_error,
)
from nss_ros.geometry import exponential, from_yaw, inverse, transform_points

twists = arrays(np.float64, 6, elements=st.floats(-3, 3))
transforms = st.builds(exponential, twists)
clouds = arrays(np.float64, (12, 3), elements=st.floats(-5, 5))


@given(transforms)
def test_no_error_of_the_truth_itself(transform):
    assert rotation_error(transform, transform) == pytest.approx(0, abs=1e-5)
    assert translation_error(transform, transform) == 0


@given(transforms, transforms)
def test_errors_are_symmetric(one, other):
    assert rotation_error(one, other) == pytest.approx(rotation_error(other, one), abs=1e-5)
    assert translation_error(one, other) == translation_error(other, one)


@given(transforms, transforms, transforms)
def test_errors_do_not_depend_on_the_target_frame(motion, one, other):
    moved = motion @ one, motion @ other
    assert rotation_error(*moved) == pytest.approx(rotation_error(one, other), abs=1e-4)
    assert translation_error(*moved) == pytest.approx(translation_error(one, other), abs=1e-9)


@given(st.floats(0, 179.9), arrays(np.float64, 3, elements=st.floats(-9, 9)))
def test_known_errors(degrees, translation):
    estimate = from_yaw(np.radians(degrees), translation)
    assert rotation_error(np.eye(4), estimate) == pytest.approx(degrees, abs=1e-5)
    assert translation_error(np.eye(4), estimate) == pytest.approx(np.linalg.norm(translation))


@given(st.lists(st.tuples(transforms, transforms), min_size=1, max_size=5))
def test_errors_of_many_equal_errors_of_each(pairs):
    truth, estimate = (np.stack(side) for side in zip(*pairs, strict=True))
    assert rotation_error(truth, estimate).tolist() == [rotation_error(*pair) for pair in pairs]
    assert translation_error(truth, estimate).tolist() == [
        translation_error(*pair) for pair in pairs
    ]


def test_limits_are_inclusive_and_no_answer_is_no_success():
    rre, rte = np.array([10.0, 10.1, 0.0, np.nan]), np.array([0.2, 0.1, 0.21, np.nan])
    success = successes(rre, rte)
    assert success.tolist() == [True, False, False, False]
    assert recall(success) == 25.0
    assert np.isnan(recall(success[:0]))


@given(clouds, transforms, transforms)
def test_rmse_does_not_depend_on_the_frame(points, estimate, motion):
    moved = transform_points(estimate, points)
    value = rmse(points, moved)
    assert value == pytest.approx(rmse(moved, points))
    both = transform_points(motion, points), transform_points(motion, moved)
    assert rmse(*both) == pytest.approx(value, abs=1e-9)
    assert rmse(points, points) == 0


@given(clouds, transforms, arrays(np.float64, 3, elements=st.floats(-2, 2)))
def test_pairwise_rmse_of_a_shifted_estimate_is_the_shift(points, truth, shift):
    source = transform_points(inverse(truth), points)
    pairs = correspondences(source, cKDTree(points), truth)
    assert pairs[:, 0].tolist() == list(range(len(points)))
    estimate = truth.copy()
    estimate[:3, 3] += shift
    assert pairwise_rmse(source, points, pairs, estimate) == pytest.approx(
        np.linalg.norm(shift), abs=1e-6
    )


def test_only_near_points_correspond():
    target = np.array([[0.0, 0, 0], [1, 0, 0]])
    source = np.array([[0.0, 0, 0.099], [1, 0.101, 0], [7, 7, 7]])
    pairs = correspondences(source, cKDTree(target), np.eye(4))
    assert pairs.tolist() == [[0, 0]]
    far = correspondences(source + 100, cKDTree(target), np.eye(4))
    assert pairwise_rmse(source, target, far, np.eye(4)) == np.inf


@given(clouds, transforms, transforms, transforms)
def test_displacement_in_the_frame_of_an_anchor(points, truth, estimate, motion):
    value = squared_displacement(points, truth, estimate)
    assert squared_displacement(points, truth, truth) == 0
    assert squared_displacement(points, estimate, truth) == pytest.approx(value)
    assert squared_displacement(points, motion @ truth, motion @ estimate) == pytest.approx(
        value, abs=1e-7
    )
    assert np.sqrt(value / len(points)) == pytest.approx(
        rmse(transform_points(truth, points), transform_points(estimate, points)), abs=1e-9
    )


def test_f1_counts_positives():
    truth = np.array([True, True, False, False])
    assert f1_score(truth, truth) == 100.0
    assert f1_score(truth, ~truth) == 0.0
    assert f1_score(truth, np.array([True, False, True, False])) == 50.0
    assert f1_score(truth & False, truth & False) == 0.0
