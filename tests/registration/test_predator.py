import pickle

import numpy as np
import pytest
import torch
from another_process import printed_by_another_process
from bad_clouds import BAD, assert_fails_cleanly
from kernel_point_weights import VOXEL_SIZE, saved, weighted

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.registration.learned.d3feat_network import D3FeatNetwork
from nss_ros.registration.learned.predator import Predator, drawn
from nss_ros.registration.learned.predator_network import PredatorNetwork

FIRST, SECOND = FragmentId("1", 1, 0), FragmentId("1", 1, 1)
# Whole voxels of the coarsest level, so that the network sees the same neighbourhoods.
SHIFT = np.array([2.0, -1.0, 0.0], dtype=np.float32)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return saved(
        weighted(PredatorNetwork(VOXEL_SIZE)), tmp_path_factory.mktemp("weights") / "indoor.pth"
    )


def config(weights, **settings):
    settings = {"weights": str(weights), "voxel_size": VOXEL_SIZE, "device": "cpu"} | settings
    return RegistrationConfig(method="predator", predator=settings)


@pytest.fixture(scope="module")
def method(weights):
    return Predator(config(weights, max_keypoints=1000))


@pytest.fixture(scope="module")
def scan(scans):
    return Fragment(FIRST, scans[0].points[::2], True)


@pytest.fixture(scope="module")
def moved(scan):
    return Fragment(SECOND, scan.points + SHIFT, True)


def test_a_scan_and_its_moved_copy(method, scan, moved):
    source, target = method.prepare(scan), method.prepare(moved)
    there, back = method.register(source, target, 0), method.register(target, source, 0)
    assert there.ok, there.message
    assert there.pair == FragmentPair(FIRST, SECOND)
    assert there.method == "predator"
    assert np.allclose(there.T_target_source[:3, 3], SHIFT, atol=0.02)
    assert np.allclose(back.T_target_source[:3, 3], -SHIFT, atol=0.02)
    assert np.allclose(there.T_target_source[:3, :3], np.eye(3), atol=0.01)


def test_what_is_kept_of_a_fragment_is_picklable_and_small(method, scan):
    features = method.prepare(scan)
    content = pickle.dumps(features)
    assert len(content) < 40 * len(scan.points)
    assert np.array_equal(pickle.loads(content).dense, features.dense)
    assert features.dense.dtype == np.float32


CODE = """
import pickle, sys
from nss_ros.registration.learned.predator import Predator
config, *scans = pickle.load(open(sys.argv[1], "rb"))
method = Predator(config)
result = method.register(*(method.prepare(scan) for scan in scans), 3)
print(result.T_target_source.tobytes().hex(), result.covariance.tobytes().hex())
"""


def test_results_are_the_same_bytes_in_any_process(method, weights, scan, moved, tmp_path):
    here = method.register(method.prepare(scan), method.prepare(moved), 3)
    given = (config(weights, max_keypoints=1000), scan, moved)
    there = printed_by_another_process(CODE, given, tmp_path, threads=4)
    arrays = (here.T_target_source, here.covariance)
    assert there.split() == [each.tobytes().hex() for each in arrays]


@pytest.mark.parametrize("cloud", BAD)
def test_bad_clouds_fail_cleanly(method, cloud, scan, capfd):
    assert_fails_cleanly(method, BAD[cloud], scan)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_without_weights_it_does_not_run():
    with pytest.raises(MethodError, match=r"registration\.predator\.weights .*OverlapPredator"):
        Predator(RegistrationConfig(method="predator"))


def test_weights_of_another_network_are_refused(tmp_path):
    file = saved(D3FeatNetwork(VOXEL_SIZE), tmp_path / "d3feat.pth")
    with pytest.raises(MethodError, match="another network"):
        Predator(config(file))


def test_weights_that_lack_a_tensor_are_refused(tmp_path):
    state = PredatorNetwork(VOXEL_SIZE).state_dict()
    del state["epsilon"]
    torch.save({"state_dict": state}, tmp_path / "indoor.pth")
    with pytest.raises(MethodError, match="'epsilon' is missing"):
        Predator(config(tmp_path / "indoor.pth"))


def test_points_are_drawn_in_proportion_to_their_scores():
    scores = np.array([1, 3, 0, 6], dtype=np.float32)
    random = np.random.default_rng(0)
    single = [drawn(scores, 1, random)[0] for _ in range(4000)]
    assert np.allclose(np.bincount(single, minlength=4) / 4000, scores / 10, atol=0.03)


def test_points_are_drawn_once_and_those_of_score_zero_last():
    scores = np.array([0, 0.5, 0, 0.5, 0.1], dtype=np.float32)
    random = np.random.default_rng(0)
    assert drawn(scores, 3, random).tolist() == [1, 3, 4]
    assert drawn(scores, 9, random).tolist() == [0, 1, 2, 3, 4]
    assert drawn(scores[:0], 9, random).tolist() == []
