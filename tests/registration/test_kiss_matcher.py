import os
import pickle

import numpy as np
import pytest
from another_process import printed_by_another_process
from bad_clouds import BAD, assert_fails_cleanly
from scipy.spatial.transform import Rotation

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_rotation, from_yaw, rotation_angle, tilt_angle, transform_points
from nss_ros.registration.kiss_matcher import KissMatcher, can_be_described, load_library
from nss_ros.registration.method import load_method, method_names
from nss_ros.registration.ransac import Matches

FIRST, SECOND = FragmentId("1", 1, 0), FragmentId("1", 1, 1)
# The room is small.
VOXEL_SIZE = 0.15


def kiss_matcher(**settings):
    settings = {"voxel_size": VOXEL_SIZE} | settings
    return KissMatcher(RegistrationConfig(method="kiss_matcher", kiss_matcher=settings))


def turned(fragment, transform, gravity_aligned):
    points = transform_points(transform, fragment.points).astype(np.float32)
    return Fragment(fragment.id, points, gravity_aligned)


def test_it_is_installed_under_its_name():
    assert "kiss_matcher" in method_names()
    method = load_method(RegistrationConfig(method="kiss_matcher"))
    assert isinstance(method, KissMatcher)
    assert method.name == "kiss_matcher"


def test_a_room_seen_twice(scans):
    T_source_room = from_yaw(2.0, (0.5, -0.2, 0.0))
    method = kiss_matcher()
    source = method.prepare(turned(scans[0], T_source_room, True))
    target = method.prepare(scans[1])
    result = method.register(source, target, 1)
    assert result.ok, result.message
    assert result.pair == FragmentPair(FIRST, SECOND)
    assert result.method == "kiss_matcher"
    error = result.T_target_source @ T_source_room
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert rotation_angle(error) < 0.02
    assert result.inlier_ratio > 0.5
    assert result.inliers == round(result.inlier_ratio * min(4000, len(source.points)))
    assert 0 < result.rmse < 0.1
    assert result.confidence > 0.5
    assert result.overlap_probability > 0.5
    assert np.array_equal(result.covariance, result.covariance.T)
    assert np.linalg.eigvalsh(result.covariance)[0] > 0


def test_a_fragment_in_any_frame(scans):
    turn = Rotation.random(rng=np.random.default_rng(4))
    T_source_room = from_rotation(turn, (2.0, -3.0, 1.0))
    noise = np.random.default_rng(0).normal(0, 0.005, scans[0].points.shape)
    again = Fragment(SECOND, (scans[0].points + noise).astype(np.float32))
    method = kiss_matcher()
    source = method.prepare(turned(scans[0], T_source_room, False))
    result = method.register(source, method.prepare(again), 0)
    assert result.ok, result.message
    error = result.T_target_source @ T_source_room
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert rotation_angle(error) < 0.02


def tilted_matches():
    """Matches on which a transform that tilts by 20 degrees agrees."""
    points = np.random.default_rng(0).uniform(-4, 4, (60, 3))
    T_target_source = from_rotation(Rotation.from_euler("x", 20, degrees=True), (1.0, 0.0, 0.0))
    normals = np.tile((0.0, 0.0, 1.0), (60, 1))
    return T_target_source, Matches(
        points, transform_points(T_target_source, points), normals, normals
    )


def test_only_levelled_pairs_are_solved_for_yaw_and_translation():
    truth, matches = tilted_matches()
    (free,) = kiss_matcher()._candidates(matches, level=False, seed=0)
    assert np.allclose(free, truth, atol=1e-3)
    for level, settings in ((True, {"yaw_only": False}), (False, {"yaw_only": True})):
        (same,) = kiss_matcher(**settings)._candidates(matches, level=level, seed=0)
        assert np.array_equal(same, free)
    level = kiss_matcher(min_inliers=0)._candidates(matches, level=True, seed=0)
    assert all(tilt_angle(each) < 1e-6 for each in level)


def test_a_transform_on_which_few_matches_agree_is_none():
    _, matches = tilted_matches()
    assert len(kiss_matcher(min_inliers=60)._candidates(matches, level=False, seed=0)) == 1
    assert kiss_matcher(min_inliers=61)._candidates(matches, level=False, seed=0) == []


CODE = """
import pickle, sys
from nss_ros.config import RegistrationConfig
from nss_ros.registration.method import load_method
scans = pickle.load(open(sys.argv[1], "rb"))
settings = {"voxel_size": 0.15}
method = load_method(RegistrationConfig(method="kiss_matcher", kiss_matcher=settings))
prepared = [method.prepare(scan) for scan in scans]
for seed in range(3):
    result = method.register(*prepared, seed)
    assert result.ok
    print(result.T_target_source.tobytes().hex(), result.covariance.tobytes().hex())
"""


def test_results_are_the_same_bytes_in_any_process_with_any_thread_count(scans, tmp_path):
    one, four = (printed_by_another_process(CODE, scans, tmp_path, n) for n in (1, 4))
    assert len(set(one.splitlines())) == 1
    assert one == four


def test_loading_the_library_leaves_the_cores_as_they_were():
    before = os.sched_getaffinity(0)
    load_library.cache_clear()
    load_library()
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize("cloud", BAD)
def test_bad_clouds_fail_cleanly(cloud, scans, capfd):
    method = kiss_matcher()
    assert_fails_cleanly(method, BAD[cloud], scans[0])
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def in_a_row(spacing, count):
    return np.arange(count)[:, None] * np.array([[spacing, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        # Normals have a radius of 0.6 m, descriptors of 1 m; both need three points.
        (np.zeros((0, 3)), False),
        (in_a_row(0.1, 2), False),
        (in_a_row(0.29, 3), True),
        (in_a_row(0.31, 3), False),  # one normal
        (in_a_row(0.59, 5), True),
        (in_a_row(0.61, 9), False),
    ],
)
def test_what_can_be_described(points, expected):
    assert can_be_described(points.astype(np.float32), 0.2) == expected


def test_features_are_picklable_and_not_finite_points_are_dropped(scans):
    method = kiss_matcher()
    spoiled = np.vstack((scans[0].points, np.full((10, 3), np.nan), np.full((10, 3), np.inf)))
    features = method.prepare(Fragment(FIRST, spoiled.astype(np.float32), True))
    again = pickle.loads(pickle.dumps(features))
    clean = method.prepare(scans[0])
    for name in ("points", "normals", "keypoints"):
        assert np.array_equal(getattr(again, name), getattr(clean, name))
