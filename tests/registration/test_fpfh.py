import pickle

import numpy as np
import pytest
from another_process import printed_by_another_process
from bad_clouds import BAD, assert_fails_cleanly
from scipy.spatial.transform import Rotation

from nss_ros.config import MultiwayConfig, RegistrationConfig
from nss_ros.dataset.challenge_folder import read_folder, read_fragment
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import (
    from_rotation,
    from_yaw,
    inverse,
    relative,
    rotation_angle,
    transform_points,
)
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.measurement import measurement
from nss_ros.multiway.pose_graph import NodeStatus
from nss_ros.registration.method import load_method
from nss_ros.registration.pair import register_pair
from nss_ros.registration.relative_transform import RelativeTransform

METHODS = ("fpfh_ransac", "fpfh_fgr")
FIRST, SECOND = FragmentId("1", 1, 0), FragmentId("1", 1, 1)


def method_named(name, **settings):
    return load_method(RegistrationConfig(method=name, **settings))


def turned(fragment, transform, gravity_aligned):
    points = transform_points(transform, fragment.points).astype(np.float32)
    return Fragment(fragment.id, points, gravity_aligned)


@pytest.mark.parametrize(
    ("name", "level"), [("fpfh_ransac", True), ("fpfh_ransac", False), ("fpfh_fgr", True)]
)
def test_a_room_seen_twice(name, level, scans):
    if level:
        T_source_room = from_yaw(2.0, np.zeros(3))
    else:
        turn = Rotation.random(rng=np.random.default_rng(4))
        T_source_room = from_rotation(turn, (2.0, -3.0, 1.0))
    method = method_named(name)
    source = method.prepare(turned(scans[0], T_source_room, level))
    target = method.prepare(turned(scans[1], np.eye(4), level))
    result = method.register(source, target, 1)
    assert result.ok, result.message
    assert result.pair == FragmentPair(FIRST, SECOND)
    assert result.method == name
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


@pytest.mark.parametrize("name", METHODS)
def test_there_and_back_agree(name, scans):
    method = method_named(name)
    one, other = (method.prepare(scan) for scan in scans)
    there = method.register(one, other, 0).T_target_source
    back = method.register(other, one, 0).T_target_source
    assert np.allclose(there @ back, np.eye(4), atol=0.02)


CODE = """
import pickle, sys
from nss_ros.config import RegistrationConfig
from nss_ros.registration.method import load_method
scans = pickle.load(open(sys.argv[1], "rb"))
for name in ("fpfh_ransac", "fpfh_fgr"):
    method = load_method(RegistrationConfig(method=name))
    result = method.register(*(method.prepare(scan) for scan in scans), 3)
    print(result.T_target_source.tobytes().hex(), result.covariance.tobytes().hex())
"""


def test_results_are_the_same_bytes_in_any_process_with_any_thread_count(scans, tmp_path):
    one, four = (printed_by_another_process(CODE, scans, tmp_path, n) for n in (1, 4))
    assert len(set(one.split())) == 4
    assert one == four


def test_features_are_picklable_and_small(scans):
    method = method_named("fpfh_ransac", fpfh={"max_keypoints": 500})
    features = method.prepare(scans[0])
    again = pickle.loads(pickle.dumps(features))
    assert len(features.keypoints) == len(features.descriptors) == 500
    assert features.descriptors.dtype == features.points.dtype == np.float32
    assert np.array_equal(again.descriptors, features.descriptors)
    assert np.allclose(np.linalg.norm(features.normals, axis=1), 1, atol=1e-4)


def test_normals_face_the_sensor(scans):
    features = method_named("fpfh_ransac").prepare(scans[0])
    assert (np.einsum("ij,ij->i", features.normals, features.points) <= 1e-6).all()


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("cloud", BAD)
def test_bad_clouds_fail_cleanly(name, cloud, scans, capfd):
    method = method_named(name)
    assert_fails_cleanly(method, BAD[cloud], scans[0])
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_not_finite_points_are_dropped(scans):
    method = method_named("fpfh_ransac")
    spoiled = np.vstack((scans[0].points, np.full((10, 3), np.nan), np.full((10, 3), np.inf)))
    features = method.prepare(Fragment(FIRST, spoiled.astype(np.float32), True))
    assert np.array_equal(features.points, method.prepare(scans[0]).points)


def is_right(result, truth):
    """Whether a result is within the benchmark's 10 degrees and 0.2 m."""
    difference = inverse(truth) @ result.T_target_source
    distance = np.linalg.norm(result.T_target_source[:3, 3] - truth[:3, 3])
    return result.ok and distance <= 0.2 and np.degrees(rotation_angle(difference)) <= 10


def test_real_scans_of_a_kitchen(shared_data):
    folder = read_folder(shared_data / "redkitchen")
    (graph,) = folder.ground_truth
    config = RegistrationConfig()
    method = load_method(config)
    features = {
        fragment: method.prepare(read_fragment(fragment, file, gravity_aligned=False)[0])
        for fragment, file in folder.point_files.items()
    }
    measurements, right = [], 0
    for edge in graph.edges:
        source, target = features[edge.pair.source], features[edge.pair.target]
        result = register_pair(method, source, target, edge.pair, config)
        right += is_right(result, edge.T_target_source)
        measurements.append(measurement(result, level=False))
    assert right >= 11
    solved = Choi(MultiwayConfig()).synchronize(list(features), measurements)
    assert {(node.status, node.component) for node in solved.nodes} == {(NodeStatus.PLACED, 0)}
    poses = solved.poses()
    for edge in graph.edges:
        T_target_source = relative(
            poses[edge.pair.source].T_map_fragment, poses[edge.pair.target].T_map_fragment
        )
        solved_edge = RelativeTransform(edge.pair, "choi", T_target_source)
        assert is_right(solved_edge, edge.T_target_source)
