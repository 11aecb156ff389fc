import pickle

import numpy as np
import pytest
import torch
from another_process import printed_by_another_process
from bad_clouds import BAD, assert_fails_cleanly
from drawn_weights import weighted
from scipy.spatial import cKDTree

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.registration.learned.geotransformer import GeoTransformer
from nss_ros.registration.learned.geotransformer_network import GeoTransformerNetwork
from nss_ros.registration.learned.local_to_global import local_to_global
from nss_ros.registration.learned.pyramid import grid_subsampled
from nss_ros.registration.method import load_method, method_names

FIRST, SECOND = FragmentId("1", 1, 0), FragmentId("1", 1, 1)
# The room is small, and no test needs all its points.
VOXEL_SIZE = 0.15
# Whole voxels of the coarsest level, so that the network sees the same neighbourhoods.
SHIFT = np.array([1.2, -2.4, 0.0], dtype=np.float32)


def checkpoint_of(network):
    """What the authors' trainer saves."""
    return {
        "epoch": 40,
        "iteration": 12345,
        "model": network.state_dict(),
        "optimizer": {"state": {}, "param_groups": [{"lr": 1e-4}]},
        "scheduler": {"last_epoch": 40},
    }


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    file = tmp_path_factory.mktemp("weights") / "geotransformer-3dmatch.pth.tar"
    with torch.no_grad():
        torch.save(checkpoint_of(weighted(GeoTransformerNetwork(VOXEL_SIZE))), file)
    return file


def config(weights, **settings):
    settings = {"weights": str(weights), "voxel_size": VOXEL_SIZE, "device": "cpu"} | settings
    return RegistrationConfig(method="geotransformer", geotransformer=settings)


@pytest.fixture(scope="module")
def method(weights):
    return GeoTransformer(config(weights))


@pytest.fixture(scope="module")
def moved_and_still(method, scans):
    """A scan moved by SHIFT, and the scan."""
    moved = Fragment(SECOND, scans[0].points + SHIFT, True)
    return method.prepare(moved), method.prepare(scans[0])


@pytest.fixture(scope="module")
def matches(method, moved_and_still):
    return method._matches(*moved_and_still)


def test_it_is_installed_under_its_name(weights):
    assert "geotransformer" in method_names()
    loaded = load_method(config(weights))
    assert isinstance(loaded, GeoTransformer)
    assert loaded.name == "geotransformer"


def test_a_checkpoint_in_the_layout_of_the_authors_is_loaded(method, weights):
    saved = torch.load(weights, weights_only=True)["model"]
    loaded = method._network.state_dict()
    assert list(loaded) == list(saved)
    assert all(torch.equal(loaded[name], saved[name]) for name in saved)
    assert not method._network.training


def test_there_is_no_result_without_weights():
    with pytest.raises(MethodError, match=r"registration\.geotransformer\.weights .*releases"):
        load_method(RegistrationConfig(method="geotransformer"))


@pytest.mark.parametrize("spoiled", ["missing", "unknown", "shape"])
def test_weights_of_another_network_are_refused(spoiled, tmp_path):
    checkpoint = checkpoint_of(GeoTransformerNetwork(VOXEL_SIZE))
    name = "transformer.embedding.proj_d.weight"
    if spoiled == "missing":
        del checkpoint["model"][name]
    elif spoiled == "unknown":
        name = "backbone.encoder5_1.norm.norm.weight"
        checkpoint["model"][name] = torch.ones(3)
    else:
        checkpoint["model"][name] = torch.zeros(2, 2)
    file = tmp_path / "other.pth.tar"
    torch.save(checkpoint, file)
    with pytest.raises(MethodError, match=f"another network .*{name}"):
        load_method(config(file))


def test_a_moved_scan_is_moved_back(method, moved_and_still):
    """Any network matches a cloud to the same cloud, if all its parts are where they belong."""
    source, target = moved_and_still
    result = method.register(source, target, 0)
    assert result.ok, result.message
    assert result.pair == FragmentPair(SECOND, FIRST)
    assert result.method == "geotransformer"
    assert np.allclose(result.T_target_source[:3, :3], np.eye(3), atol=1e-3)
    assert np.allclose(result.T_target_source[:3, 3], -SHIFT, atol=1e-3)
    assert result.inlier_ratio > 0.99
    back = method.register(target, source, 0)
    assert np.allclose(back.T_target_source[:3, 3], SHIFT, atol=1e-3)


def test_matches_are_points_of_the_two_clouds(moved_and_still, matches):
    source, target = moved_and_still
    assert len(matches) > 1000
    for points, normals, features in (
        (matches.source, matches.source_normals, source),
        (matches.target, matches.target_normals, target),
    ):
        fine = grid_subsampled(features.cloud, 2 * VOXEL_SIZE)
        assert cKDTree(fine).query(points)[0].max() == 0
        assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    right = np.linalg.norm(matches.source - SHIFT - matches.target, axis=1) < VOXEL_SIZE
    assert right.mean() > 0.1
    assert (matches.scores > 0.05).all()
    assert (np.diff(matches.patches) >= 0).all()
    assert len(np.unique(matches.patches)) > 100


def test_the_candidate_is_that_of_local_to_global_registration(method, matches):
    (candidate,) = method._candidates(matches, True, 0)
    assert np.allclose(candidate[:3, 3], -SHIFT, atol=0.02)
    same, narrow, wide = (local_to_global(matches, each * VOXEL_SIZE) for each in (4, 3, 5))
    assert np.array_equal(candidate, same)
    assert not np.array_equal(candidate, narrow)
    assert not np.array_equal(candidate, wide)


class SeenError(Exception):
    """The network has got its input, and need not go on."""


def test_the_network_sees_the_target_first_and_as_many_neighbours_as_in_training(method):
    random = np.random.default_rng(0)
    dense = method.prepare(Fragment(FIRST, random.uniform(0, 6, (60_000, 3)).astype(np.float32)))
    sparse = method.prepare(Fragment(SECOND, random.uniform(0, 3, (900, 3)).astype(np.float32)))
    seen = []

    def see(_, inputs):
        seen.extend(inputs[0])
        raise SeenError

    handle = method._network.register_forward_pre_hook(see)
    with pytest.raises(SeenError):
        method._matches(sparse, dense)
    handle.remove()
    assert [level.neighbours.shape[1] for level in seen] == [38, 36, 36, 38]
    assert seen[0].lengths == (len(dense.cloud), len(sparse.cloud))
    assert np.array_equal(seen[0].points[: len(dense.cloud)], dense.cloud)
    point, rank = (seen[0].neighbours < len(seen[0].points)).nonzero(as_tuple=True)
    offsets = seen[0].points[point] - seen[0].points[seen[0].neighbours[point, rank]]
    assert 2.4 * VOXEL_SIZE < offsets.norm(dim=1).max() <= 2.5 * VOXEL_SIZE


CODE = """
import pickle, sys
from nss_ros.config import RegistrationConfig
from nss_ros.registration.method import load_method
scans, weights = pickle.load(open(sys.argv[1], "rb"))
settings = {"weights": weights, "voxel_size": 0.15, "device": "cpu"}
method = load_method(RegistrationConfig(method="geotransformer", geotransformer=settings))
prepared = [method.prepare(scan) for scan in scans]
matches = method._matches(*prepared)
print(matches.source.tobytes().hex(), matches.scores.tobytes().hex())
candidates = [method._candidates(matches, True, seed)[0].tobytes().hex() for seed in range(2)]
assert candidates[0] == candidates[1]
print(candidates[0])
"""


def test_results_are_the_same_bytes_in_any_process_with_any_thread_count(scans, weights, tmp_path):
    thin = [Fragment(scan.id, scan.points[::4], True) for scan in scans]
    inputs = (thin, str(weights))
    one, four = (printed_by_another_process(CODE, inputs, tmp_path, n) for n in (1, 4))
    assert one
    assert one == four


# Points that are scattered are rightly registered to themselves.
@pytest.mark.parametrize("name", sorted(BAD.keys() - {"scattered"}))
def test_bad_clouds_fail_cleanly(name, method, scans, capfd):
    cloud = BAD[name][::4] if len(BAD[name]) > 100 else BAD[name]
    assert_fails_cleanly(method, cloud, Fragment(FIRST, scans[0].points[::5], True))
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_scattered_points_do_not_fit_a_scan(method, scans):
    scattered = method.prepare(Fragment(SECOND, BAD["scattered"][::4].astype(np.float32), True))
    scan = method.prepare(Fragment(FIRST, scans[0].points[::5], True))
    result = method.register(scattered, scan, 0)
    assert not result.ok
    assert result.message.endswith(".")


def test_features_are_picklable_and_not_finite_points_are_dropped(method, scans):
    spoiled = np.vstack((scans[0].points, np.full((10, 3), np.nan), np.full((10, 3), np.inf)))
    features = method.prepare(Fragment(FIRST, spoiled.astype(np.float32), True))
    again = pickle.loads(pickle.dumps(features))
    clean = method.prepare(scans[0])
    for name in ("points", "normals", "cloud"):
        assert np.array_equal(getattr(again, name), getattr(clean, name))
