import pickle

import numpy as np
import pytest
import torch
from another_process import printed_by_another_process
from bad_clouds import BAD, assert_fails_cleanly
from kernel_point_weights import VOXEL_SIZE, saved, weighted

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, voxelize
from nss_ros.registration.learned.d3feat import D3Feat
from nss_ros.registration.learned.d3feat_network import D3FeatNetwork
from nss_ros.registration.learned.predator_network import PredatorNetwork

FIRST, SECOND = FragmentId("1", 1, 0), FragmentId("1", 1, 1)
# Whole voxels of the coarsest level, so that the network sees the same neighbourhoods.
SHIFT = np.array([2.0, -4.0, 0.0], dtype=np.float32)


@pytest.fixture(scope="module")
def network():
    return weighted(D3FeatNetwork(VOXEL_SIZE))


@pytest.fixture(scope="module")
def weights(network, tmp_path_factory):
    return saved(network, tmp_path_factory.mktemp("weights") / "model_best_acc.pth")


def config(weights, **settings):
    settings = {"weights": str(weights), "voxel_size": VOXEL_SIZE, "device": "cpu"} | settings
    return RegistrationConfig(method="d3feat", d3feat=settings)


@pytest.fixture(scope="module")
def method(weights):
    return D3Feat(config(weights, max_keypoints=1000))


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
    assert there.method == "d3feat"
    assert np.allclose(there.T_target_source[:3, 3], SHIFT, atol=0.02)
    assert np.allclose(back.T_target_source[:3, 3], -SHIFT, atol=0.02)
    assert np.allclose(there.T_target_source[:3, :3], np.eye(3), atol=0.01)


def test_keypoints_are_those_with_the_highest_scores(weights, scan):
    few, many = (
        D3Feat(config(weights, max_keypoints=count)).prepare(scan).described
        for count in (50, 10**6)
    )
    assert np.array_equal(few.points, many.points[:50])
    assert np.array_equal(few.descriptors, many.descriptors[:50])
    assert len(many.points) == len(voxelize(scan.points, VOXEL_SIZE))


def test_features_are_picklable_and_small(method, scan):
    features = method.prepare(scan)
    again = pickle.loads(pickle.dumps(features))
    described = features.described
    assert described.descriptors.shape == (1000, 32)
    assert described.descriptors.dtype == described.points.dtype == np.float32
    assert np.array_equal(again.described.descriptors, described.descriptors)
    assert np.allclose(np.linalg.norm(described.normals, axis=1), 1, atol=1e-4)


CODE = """
import pickle, sys
from nss_ros.registration.learned.d3feat import D3Feat
config, *scans = pickle.load(open(sys.argv[1], "rb"))
method = D3Feat(config)
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
    with pytest.raises(MethodError, match=r"registration\.d3feat\.weights .*D3Feat\.pytorch"):
        D3Feat(RegistrationConfig(method="d3feat"))


def test_weights_of_another_network_are_refused(tmp_path):
    file = saved(PredatorNetwork(VOXEL_SIZE), tmp_path / "indoor.pth")
    with pytest.raises(MethodError, match="another network"):
        D3Feat(config(file))


def test_older_weights_have_no_biases_of_unary_layers(network, scan, tmp_path):
    state = network.state_dict()
    zero = {name: each * 0 if name.endswith("mlp.bias") else each for name, each in state.items()}
    none = {name: each for name, each in state.items() if not name.endswith("mlp.bias")}
    assert len(none) == 111
    found = []
    for name, tensors in (("zero", zero), ("none", none), ("all", state)):
        torch.save({"state_dict": tensors}, tmp_path / f"{name}.pth")
        found.append(D3Feat(config(tmp_path / f"{name}.pth")).prepare(scan).described.descriptors)
    assert np.array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_weights_with_some_of_these_biases_are_refused(network, tmp_path):
    state = dict(network.state_dict())
    del state["decoder_blocks.7.mlp.bias"]
    torch.save({"state_dict": state}, tmp_path / "model.pth")
    with pytest.raises(MethodError, match=r"'decoder_blocks\.7\.mlp\.bias' is missing"):
        D3Feat(config(tmp_path / "model.pth"))
