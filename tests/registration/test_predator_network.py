import numpy as np
import pytest
import torch
from kernel_point_weights import VOXEL_SIZE, cloud, layout, levels_of, weighted
from torch.nn import functional

from nss_ros.registration.learned.predator_network import (
    DEPTH,
    InstanceNormalisation,
    PredatorNetwork,
)


@pytest.fixture(scope="module")
def network():
    return weighted(PredatorNetwork(VOXEL_SIZE))


@pytest.fixture(scope="module")
def clouds():
    return [cloud(0), cloud(1)[::2]]


@pytest.fixture(scope="module")
def outputs(network, clouds):
    return network(levels_of(clouds, DEPTH))


def test_tensors_are_named_as_those_of_the_authors():
    count, digest = layout(PredatorNetwork(VOXEL_SIZE))
    assert count == 74
    assert digest == "a77cfc5c8cef1c7dea7dcf66d55099ab97d0c4590426926cc0b54d3db4169c94"


def test_outputs_are_those_of_the_official_code(outputs):
    """What the code of github.com/prs-eth/OverlapPredator gives with these weights and points."""
    descriptors, overlap, saliency = outputs
    rows = [0, 1951, 5854]
    assert descriptors.shape == (5855, 32)
    expected = [
        [-0.015209, 0.103484, 0.172892, 0.160777],
        [0.097995, -0.304713, 0.220672, 0.141737],
        [0.049378, 0.290206, 0.320229, -0.210059],
    ]
    assert np.allclose(descriptors[rows, :4], expected, atol=1e-4)
    assert np.allclose(overlap[rows], [0.984453, 0.920649, 0.995433], atol=1e-4)
    assert np.allclose(saliency[rows], [0.526146, 0.232556, 0.048569], atol=1e-4)
    assert float(descriptors.abs().sum()) == pytest.approx(26719.7802, abs=0.1)
    assert float(overlap.sum()) == pytest.approx(4785.5465, abs=0.1)
    assert float(saliency.sum()) == pytest.approx(2453.4004, abs=0.1)


def test_descriptors_are_unit_vectors(outputs):
    assert torch.allclose(torch.linalg.norm(outputs[0], dim=1), torch.tensor(1.0), atol=1e-5)


def test_moved_clouds_have_the_same_outputs(network, clouds, outputs):
    # By whole voxels of the coarsest level, of points that sums in float32 are exact for.
    exact = [np.round(each * 256) / np.float32(256) for each in clouds]
    still = network(levels_of(exact, DEPTH))
    moved = network(levels_of([exact[0] + np.float32(2), exact[1] - np.float32(4)], DEPTH))
    assert not torch.allclose(still[1], outputs[1], atol=1e-5)
    for one, other in zip(still, moved, strict=True):
        close = (one - other).abs().reshape(len(one), -1).amax(dim=1) < 1e-3
        assert close.float().mean() > 0.99


def test_scores_depend_on_the_other_cloud(network, clouds, outputs):
    levels = levels_of([clouds[0], clouds[1] * np.float32(0.5)], DEPTH)
    other = network(levels)
    count = len(clouds[0])
    assert (outputs[1][:count] - other[1][:count]).abs().max() > 0.01


def test_instance_normalisation_against_that_of_torch():
    features = torch.randn(40, 6, generator=torch.Generator().manual_seed(0)) * 3 + 2
    expected = functional.instance_norm(features.T[None])[0].T
    assert torch.allclose(InstanceNormalisation(6)(features), expected, atol=1e-5)


def test_a_single_point_each(network):
    point = np.zeros((1, 3), dtype=np.float32)
    found = network(levels_of([point, point], DEPTH))
    assert all(each.isfinite().all() for each in found)
