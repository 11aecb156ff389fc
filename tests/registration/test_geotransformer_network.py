"""The network against values that the official code computed with the same weights and clouds."""

import hashlib

import numpy as np
import pytest
import torch
from drawn_weights import weighted

from nss_ros.registration.learned.geotransformer_network import GeoTransformerNetwork
from nss_ros.registration.learned.local_to_global import PatchMatches, local_to_global
from nss_ros.registration.learned.pyramid import pyramid

VOXEL_SIZE = 0.025
LIMITS = (38, 36, 36, 38)


def corner(seed, count, turn=0.0):
    """Points (n, 3) on three walls of a metre, and on a box in their corner."""
    random = np.random.default_rng(seed)
    points = random.uniform(0, 1, (count, 3))
    points[np.arange(count), np.arange(count) % 3] = 0
    points[::4] = points[::4] * 0.3 + 0.3
    cosine, sine = np.cos(turn), np.sin(turn)
    return (points @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])).astype(
        np.float32
    )


def levels():
    clouds = corner(1, 4000), corner(2, 3000, turn=0.4)
    return pyramid(clouds, VOXEL_SIZE, 2.5 * VOXEL_SIZE, LIMITS, torch.device("cpu"))


@pytest.fixture(scope="module")
def found():
    """Network, levels, features of the backbone, and target and source described."""
    with torch.inference_mode():
        network, pair = weighted(GeoTransformerNetwork(VOXEL_SIZE)), levels()
        return network, pair, network.backbone(pair), network.describe(pair)


def is_close(values, expected):
    return np.allclose(values, expected, rtol=0, atol=2e-4)


def test_parameters_are_named_and_shaped_as_the_official_ones():
    state = GeoTransformerNetwork(VOXEL_SIZE).state_dict()
    lines = [f"{name} {tuple(tensor.shape)}" for name, tensor in sorted(state.items())]
    assert len(lines) == 269
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()
    assert digest == "6a2df4569c3b8441f70ebf5da632cb5661520041c5fa777c2cb88f136e56a6b3"


def test_features_of_points_and_superpoints(found):
    _, pair, (fine, coarse), _ = found
    assert [level.lengths for level in pair] == [(4000, 3000), (1150, 1207), (311, 378), (68, 95)]
    assert is_close(fine[100, :4], (-0.990556, -1.334986, 0.052042, 1.095866))
    assert is_close(fine[-1, :4], (-0.833362, -4.677284, 2.233301, 0.829188))
    assert is_close(coarse[3, :4], (1.128441, 0.411819, 0.089802, 1.460480))
    assert is_close(coarse[-1, :4], (0.785035, -0.026385, 3.015809, 1.986925))


def test_superpoints_after_the_transformer(found):
    _, pair, (fine, _), (target, source) = found
    assert is_close(target.descriptors[3, :4], (0.004302, -0.011657, -0.006235, 0.042220))
    assert is_close(source.descriptors[-1, :4], (0.048911, -0.035557, -0.014575, 0.080119))
    assert torch.equal(torch.cat((target.features, source.features)), fine)
    assert torch.equal(torch.cat((target.superpoints, source.superpoints)), pair[3].points)


def test_matched_points_and_their_transform(found):
    network, _, _, (target, source) = found
    with torch.inference_mode():
        matches = network.matches(target, source)
    assert abs(len(matches.scores) - 6245) < 10
    assert abs(float(matches.scores.sum()) - 589.96) < 1
    assert np.allclose(matches.target.mean(dim=0), (0.408137, 0.255731, 0.429678), atol=2e-3)
    assert np.allclose(matches.source.mean(dim=0), (0.200415, 0.363528, 0.451686), atol=2e-3)
    numbers = matches.patches.numpy()
    assert (np.diff(numbers) >= 0).all()
    nothing = np.zeros((len(numbers), 3))
    transform = local_to_global(
        PatchMatches(
            *(each.double().numpy() for each in (matches.source, matches.target)),
            nothing,
            nothing,
            matches.scores.double().numpy(),
            numbers,
        ),
        radius=0.1,
    )
    expected = (
        (0.926730, 0.375589, -0.010204, 0.019914),
        (-0.375550, 0.926786, 0.005534, -0.011574),
        (0.011536, -0.001296, 0.999933, -0.005665),
    )
    assert np.allclose(transform[:3], expected, atol=5e-3)
