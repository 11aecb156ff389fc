import numpy as np
import pytest

from nss_ros.config import RegistrationConfig
from nss_ros.geometry import exponential, inverse, logarithm, transform_points
from nss_ros.icp import Surface, refine
from nss_ros.registration.features import describe
from nss_ros.registration.relative_transform import Reason
from nss_ros.registration.validation import support, verdict

CONFIG = RegistrationConfig()


@pytest.fixture(scope="module")
def surfaces(scans):
    described = [describe(scan, CONFIG) for scan in scans]
    return [Surface.of(each.points, each.normals) for each in described]


def moved(surface, transform):
    return Surface.of(
        transform_points(transform, surface.points), surface.normals @ transform[:3, :3].T
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_small_displacement_is_undone(surfaces, seed):
    source, target = surfaces
    twist = np.random.default_rng(seed).uniform(-0.06, 0.06, 6)
    refined = refine(source, target, exponential(twist), 0.1, 40)
    error = logarithm(refined.T_target_source)
    assert refined.converged
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.linalg.norm(error[3:]) < 0.005
    assert refined.rmse < 0.02


def test_the_result_follows_the_frames(surfaces):
    source, target = surfaces
    T_other_target = exponential((3.0, -2.0, 0.5, 0.4, -1.0, 0.7))
    plain = refine(source, target, np.eye(4), 0.1, 40)
    turned = refine(source, moved(target, T_other_target), T_other_target, 0.1, 40)
    assert np.allclose(
        inverse(T_other_target) @ turned.T_target_source, plain.T_target_source, atol=1e-3
    )


def test_information_is_in_the_target_frame_and_of_an_honest_size(surfaces):
    source, target = surfaces
    T_far_target = exponential((10.0, 0, 0, 0, 0, 0))
    near = np.linalg.inv(refine(source, target, np.eye(4), 0.1, 40).information)
    far = np.linalg.inv(
        refine(source, moved(target, T_far_target), T_far_target, 0.1, 40).information
    )
    assert np.allclose(near[3:, 3:], far[3:, 3:], rtol=0.05)
    # A turn about the target's origin moves fragments that are 10 m away sideways.
    assert far[1, 1] == pytest.approx(near[1, 1] + 100 * near[5, 5], rel=0.2)
    assert 1e-4 < np.sqrt(np.diag(near)).max() < 0.05


def test_far_apart_surfaces_have_no_correspondences(surfaces):
    source, target = surfaces
    start = exponential((100.0, 0, 0, 0, 0, 0))
    refined = refine(source, target, start, 0.1, 40)
    assert refined.correspondences == 0
    assert np.allclose(refined.T_target_source, start)
    assert not refined.information.any()


def test_support_of_right_and_of_wrong_alignments(surfaces):
    source, target = surfaces
    right = support(source, target, np.eye(4), CONFIG)
    wrong = support(source, target, exponential((0.4, 0.3, 0.3, 0, 0, 0.5)), CONFIG)
    none = support(source, target, exponential((100.0, 0, 0, 0, 0, 0)), CONFIG)
    assert right.inlier_ratio > 0.5
    assert right.agreement > 0.9
    assert right.rmse < wrong.rmse
    assert right.score > 2 * wrong.score
    assert none.inliers == 0
    assert not right.flat


def test_verdicts(surfaces):
    source, target = surfaces
    tilted = exponential((0, 0, 0, 0.2, 0, 0))
    right = support(source, target, np.eye(4), CONFIG)
    none = support(source, target, exponential((100.0, 0, 0, 0, 0, 0)), CONFIG)
    assert verdict(right, np.eye(4), True, CONFIG) == (Reason.NONE, "")
    assert verdict(right, tilted, False, CONFIG)[0] is Reason.NONE
    reason, message = verdict(right, tilted, True, CONFIG)
    assert reason is Reason.NOT_LEVEL
    assert "11.5 degrees" in message
    assert verdict(none, np.eye(4), True, CONFIG)[0] is Reason.TOO_FEW_INLIERS
