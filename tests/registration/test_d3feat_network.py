import numpy as np
import pytest
import torch
from kernel_point_weights import VOXEL_SIZE, cloud, layout, levels_of, weighted

from nss_ros.registration.learned.d3feat_network import DEPTH, D3FeatNetwork, detection_scores


@pytest.fixture(scope="module")
def network():
    return weighted(D3FeatNetwork(VOXEL_SIZE))


def test_tensors_are_named_as_those_of_the_authors(network):
    count, digest = layout(network)
    assert count == 146
    assert digest == "507579e9d4d921543ff3b3a969ac958e32699fcaa6d0bff5c4826f3c965e9986"


def test_descriptors_are_those_of_the_official_code(network):
    """What the code of github.com/XuyangBai/D3Feat.pytorch gives with these weights and points."""
    descriptors, scores = network(levels_of([cloud(0)], DEPTH))
    expected = [
        [0.026179, 0.069651, -0.079652, -0.010167],
        [-0.005021, 0.074501, -0.028489, -0.003427],
        [0.164359, 0.144693, 0.27959, -0.062704],
    ]
    assert descriptors.shape == (3915, 32)
    assert scores.shape == (3915,)
    assert np.allclose(descriptors[[0, 1305, 3914], :4], expected, atol=1e-5)
    assert float(descriptors.abs().sum()) == pytest.approx(18347.0481, abs=0.1)
    # A few points more or less are detected, by the last digits of features that are alike.
    assert float(scores.sum()) == pytest.approx(1398.7, abs=15)


def test_moved_clouds_have_the_same_descriptors(network):
    points = np.round(cloud(0) * 256) / np.float32(256)
    still, _ = network(levels_of([points], DEPTH))
    moved, _ = network(levels_of([points + np.float32(4)], DEPTH))
    assert ((still - moved).abs().amax(dim=1) < 1e-4).float().mean() > 0.99


def test_detection_scores_against_their_formula():
    random = np.random.default_rng(0)
    count = 60
    features = random.normal(0.3, 1, (count, 5))
    near = np.full((count, 6), count)
    for row in range(count):
        others = random.permutation(np.delete(np.arange(count), row))[: random.integers(0, 6)]
        near[row, : 1 + len(others)] = [row, *others]
    scaled = features / (features.max() + 1e-6)
    expected = []
    for row in range(count):
        about = scaled[near[row][near[row] < count]]
        highest = about.max(axis=0) if len(about) == 6 else np.maximum(about.max(axis=0), 0)
        salient = np.log1p(np.exp(scaled[row] - about.mean(axis=0)))
        dominant = scaled[row] / (scaled[row].max() + 1e-6)
        detected = (scaled[row] >= highest).any()
        expected.append((salient * dominant).max() if detected else 0.0)
    found = detection_scores(torch.from_numpy(features), torch.from_numpy(near))
    assert 0 < np.count_nonzero(expected) < count
    assert np.allclose(found, expected)


def test_a_single_point(network):
    descriptors, scores = network(levels_of([np.zeros((1, 3), dtype=np.float32)], DEPTH))
    assert descriptors.shape == (1, 32)
    assert descriptors.isfinite().all()
    assert scores.isfinite().all()
