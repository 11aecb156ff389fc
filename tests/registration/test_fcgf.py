import pickle

import numpy as np
import pytest
import torch
from another_process import printed_by_another_process
from bad_clouds import BAD, assert_fails_cleanly
from official_checkpoint import random_tensors, write_checkpoint

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, inverse, rotation_angle
from nss_ros.registration.learned.fcgf import Fcgf, one_per_voxel
from nss_ros.registration.learned.res_unet import LARGEST_STRIDE, ResUNet
from nss_ros.registration.learned.sparse_convolution import LIMIT
from nss_ros.registration.method import load_method, method_names
from nss_ros.registration.relative_transform import Reason

SECOND = FragmentId("1", 1, 1)
VOXEL_SIZE = 0.2
# Fewer than usual.
RANSAC = {"ransac_iterations": 20_000, "hypotheses": 10}


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    """Weights at random: they show that what belongs together is put together, no more."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("fcgf") / "weights.pth"
    return write_checkpoint(path, random_tensors(ResUNet(16, 5)), zipped=False)


def fcgf(weights, **settings):
    settings = {"weights": weights, "voxel_size": VOXEL_SIZE} | settings
    return load_method(RegistrationConfig(method="fcgf", fcgf=settings, fpfh=RANSAC))


def test_it_is_installed_under_its_name(weights):
    assert "fcgf" in method_names()
    method = fcgf(weights)
    assert isinstance(method, Fcgf)
    assert method.name == "fcgf"
    assert method.inlier_distance == 0.15
    assert fcgf(weights, inlier_distance=0.3).inlier_distance == 0.3


def test_it_refuses_without_weights():
    with pytest.raises(MethodError, match=r"set registration.fcgf.weights to a checkpoint"):
        fcgf("")


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors: tensors.pop("block3.conv2.kernel"),
        lambda tensors: tensors.pop("conv1.kernel"),
        lambda tensors: tensors.pop("final.bias"),
        lambda tensors: tensors.update({"conv1.kernel": torch.ones(100, 1, 32)}),
        lambda tensors: tensors.update({"conv1.kernel": torch.ones(0)}),
        lambda tensors: tensors.update({"conv2.kernel": torch.ones(27, 32, 32)}),
        lambda tensors: tensors.update({"final.bias": torch.tensor(1.0)}),
        lambda tensors: tensors.update({"block1_tr.conv1.kernel": torch.ones(27, 64, 64)}),
    ],
)
def test_it_refuses_weights_of_another_network(change, tmp_path):
    tensors = random_tensors(ResUNet(16, 5))
    change(tensors)
    path = write_checkpoint(tmp_path / "weights.pth", tensors)
    with pytest.raises(MethodError, match="holds weights of another network"):
        fcgf(path)


@pytest.mark.parametrize(
    ("width", "first_size", "zipped"), [(32, 7, True), (32, 5, False), (16, 3, True)]
)
def test_the_checkpoint_says_how_large_the_network_is(width, first_size, zipped, scans, tmp_path):
    tensors = random_tensors(ResUNet(width, first_size))
    method = fcgf(write_checkpoint(tmp_path / "weights.pth", tensors, zipped), max_keypoints=50)
    assert method.prepare(scans[0]).described.descriptors.shape == (50, width)


def test_a_moved_copy(weights, scans):
    scan = Fragment(scans[0].id, scans[0].points, False)
    # Random weights describe a voxel alike only in a grid that moved with it.
    T_target_source = from_yaw(0.0, np.array([3, -1, 1]) * LARGEST_STRIDE * VOXEL_SIZE)
    moved = (scan.points + T_target_source[:3, 3]).astype(np.float32)
    method = fcgf(weights)
    source, target = method.prepare(scan), method.prepare(Fragment(SECOND, moved, False))
    result = method.register(source, target, 1)
    assert result.ok, result.message
    assert result.pair == FragmentPair(scan.id, SECOND)
    assert result.method == "fcgf"
    error = result.T_target_source @ inverse(T_target_source)
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert rotation_angle(error) < 0.005
    assert result.inlier_ratio > 0.9


def test_keypoints(weights, scans):
    method = fcgf(weights, max_keypoints=300)
    features = method.prepare(scans[0])
    again = pickle.loads(pickle.dumps(features)).described
    described = features.described
    assert described.points.shape == described.normals.shape == (300, 3)
    assert described.descriptors.shape == (300, 16)
    for name in ("points", "normals", "descriptors"):
        assert getattr(described, name).dtype == np.float32
        assert np.array_equal(getattr(again, name), getattr(described, name))
    assert np.array_equal(described.descriptors, np.round(described.descriptors))
    assert np.allclose(np.linalg.norm(described.descriptors, axis=1), 2000, atol=3)
    assert np.allclose(np.linalg.norm(described.normals, axis=1), 1, atol=1e-4)
    points = {tuple(point) for point in scans[0].points.tolist()}
    assert {tuple(point) for point in described.points.tolist()} <= points
    voxels = np.floor(described.points.astype(np.float64) / VOXEL_SIZE)
    assert len(np.unique(voxels, axis=0)) == 300
    # They are of the whole scan.
    assert (np.ptp(described.points, axis=0) > 0.9 * np.ptp(scans[0].points, axis=0)).all()
    everything = fcgf(weights, max_keypoints=10**6).prepare(scans[0]).described
    assert len(everything.points) > 300


def test_the_order_of_points_decides_only_which_of_a_voxel_is_kept(weights, scans):
    method = fcgf(weights)
    mixed = np.random.default_rng(0).permutation(scans[0].points)
    one, other = (
        method.prepare(Fragment(scans[0].id, points, True)).described
        for points in (scans[0].points, mixed)
    )
    assert np.array_equal(one.descriptors, other.descriptors)
    assert not np.array_equal(one.points, other.points)
    first, second = (np.floor(each.points.astype(np.float64) / VOXEL_SIZE) for each in (one, other))
    assert np.array_equal(first, second)


def test_the_first_point_of_a_voxel_is_kept():
    points = np.array(
        [[0.21, 0, 0], [-0.01, 0, 0], [0.29, 0, 0], [-0.09, 0, 0], [0.25, 0.3, -0.3], [9e9, 0, 0]],
        dtype=np.float32,
    )
    kept, voxels = one_per_voxel(points, 0.1)
    assert np.array_equal(kept, points[[1, 0, 4]])
    assert voxels.tolist() == [[-1, 0, 0], [2, 0, 0], [2, 3, -4]]


def test_points_that_are_too_far_are_left_out(weights, scans):
    far = np.array([[VOXEL_SIZE * LIMIT, 0, 0], [0, -1e30, 0]], dtype=np.float32)
    features = fcgf(weights).prepare(Fragment(SECOND, np.vstack((scans[0].points, far)), True))
    clean = fcgf(weights).prepare(scans[0])
    assert np.array_equal(features.described.descriptors, clean.described.descriptors)


def test_not_finite_points_are_dropped(weights, scans):
    method = fcgf(weights)
    spoiled = np.vstack((scans[0].points, np.full((10, 3), np.nan), np.full((10, 3), np.inf)))
    features = method.prepare(Fragment(scans[0].id, spoiled.astype(np.float32), True))
    clean = method.prepare(scans[0])
    assert np.array_equal(features.points, clean.points)
    assert np.array_equal(features.described.descriptors, clean.described.descriptors)


def test_too_few_points(weights, scans):
    method = fcgf(weights)
    few = method.prepare(Fragment(SECOND, scans[0].points[:50], True))
    result = method.register(few, method.prepare(scans[0]), 0)
    assert result.reason is Reason.TOO_FEW_POINTS


@pytest.mark.parametrize("cloud", sorted(set(BAD) - {"scattered"}))
def test_bad_clouds_fail_cleanly(cloud, weights, scans, capfd):
    assert_fails_cleanly(fcgf(weights), BAD[cloud], scans[0])
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_scattered_points_match_nothing_but_themselves(weights, scans):
    method = fcgf(weights)
    points = BAD["scattered"].astype(np.float32)
    bad, good = method.prepare(Fragment(SECOND, points, True)), method.prepare(scans[0])
    assert not method.register(bad, good, 0).ok
    assert not method.register(good, bad, 0).ok
    same = method.register(bad, bad, 0)
    assert np.allclose(same.T_target_source, np.eye(4), atol=1e-4)


CODE = """
import pickle, sys
from nss_ros.config import RegistrationConfig
from nss_ros.registration.method import load_method
weights, *scans = pickle.load(open(sys.argv[1], "rb"))
settings = {"weights": weights, "voxel_size": 0.2}
ransac = {"ransac_iterations": 20_000, "hypotheses": 10}
method = load_method(RegistrationConfig(method="fcgf", fcgf=settings, fpfh=ransac))
source, target = (method.prepare(scan) for scan in scans)
print(source.described.descriptors.tobytes().hex(), target.described.points.tobytes().hex())
result = method.register(source, target, 3)
assert result.ok
print(result.T_target_source.tobytes().hex(), result.covariance.tobytes().hex())
"""


def test_results_are_the_same_bytes_in_any_process_with_any_thread_count(weights, scans, tmp_path):
    again = Fragment(SECOND, scans[0].points, True)
    content = (weights, scans[0], again)
    one, four = (printed_by_another_process(CODE, content, tmp_path, n) for n in (1, 4))
    assert len(set(one.split())) == 4
    assert one == four
