import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nss_ros.registration.learned.kernel_points import (
    KERNEL_SIZE,
    KernelPointConvolution,
    max_pooled,
)
from nss_ros.registration.learned.pyramid import radius_neighbours

RADIUS, EXTENT = 0.5, 0.4


def scene(count=120, channels=6):
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (count, 3)).astype(np.float32)
    features = torch.from_numpy(random.normal(size=(count, channels)).astype(np.float32))
    near = torch.from_numpy(radius_neighbours(points[:40], points, RADIUS, 12))
    return torch.from_numpy(points[:40]), torch.from_numpy(points), near, features


def convolution(inside=6, outside=5):
    torch.manual_seed(0)
    return KernelPointConvolution(inside, outside, RADIUS, EXTENT).requires_grad_(False)


def test_a_convolution_against_its_formula():
    queries, supports, neighbours, features = scene()
    layer = convolution()
    expected = np.zeros((len(queries), 5))
    for row, query in enumerate(queries.double()):
        counted = 0
        for index in neighbours[row].tolist():
            if index == len(supports):
                continue
            counted += float(features[index].sum()) > 0
            for kernel in range(KERNEL_SIZE):
                offset = supports[index].double() - query - layer.kernel_points[kernel]
                influence = max(0.0, 1 - float(torch.linalg.norm(offset)) / EXTENT)
                product = features[index].double() @ layer.weights[kernel].double()
                expected[row] += influence * product.numpy()
        expected[row] /= max(counted, 1)
    found = layer(queries, supports, neighbours, features)
    assert np.abs(expected).max() > 0.1
    assert np.allclose(found, expected, atol=1e-6)


def test_a_large_cloud_is_convolved_like_its_parts():
    queries, supports, neighbours, features = scene()
    layer = convolution()
    many = layer(queries.repeat(500, 1), supports, neighbours.repeat(500, 1), features)
    once = layer(queries, supports, neighbours, features)
    assert len(many) == 20_000
    assert torch.allclose(many, once.repeat(500, 1), atol=1e-6)


def test_points_and_neighbours_may_be_numbered_otherwise():
    queries, supports, neighbours, features = scene()
    layer = convolution()
    order = torch.randperm(len(supports), generator=torch.Generator().manual_seed(1))
    places = torch.cat((torch.argsort(order), torch.tensor([len(supports)])))
    again = layer(queries, supports[order], places[neighbours].flip(1), features[order])
    assert torch.allclose(again, layer(queries, supports, neighbours, features), atol=1e-6)


def test_the_kernel_turns_and_moves_with_the_points():
    queries, supports, neighbours, features = scene()
    layer, turned = convolution(), convolution()
    rotation = torch.from_numpy(Rotation.random(rng=np.random.default_rng(3)).as_matrix()).float()
    turned.kernel_points.copy_(layer.kernel_points @ rotation.T)
    shift = torch.tensor([3.0, -2.0, 1.0])
    found = turned(
        queries @ rotation.T + shift, supports @ rotation.T + shift, neighbours, features
    )
    assert torch.allclose(found, layer(queries, supports, neighbours, features), atol=1e-5)


def test_a_point_without_neighbours_has_no_features():
    _, supports, _, features = scene()
    far = torch.full((3, 3), 50.0)
    neighbours = torch.full((3, 1), len(supports))
    assert not convolution()(far, supports, neighbours, features).any()


def test_kernel_points_differ_and_lie_within_the_radius():
    points = convolution().kernel_points
    distances = torch.cdist(points, points) + torch.eye(KERNEL_SIZE)
    assert points.shape == (KERNEL_SIZE, 3)
    assert not points[0].any()
    assert distances.min() > RADIUS / 3
    assert torch.linalg.norm(points, dim=1).max() < RADIUS


@pytest.mark.parametrize("shadow", [False, True])
def test_pooling_takes_the_largest_or_the_zero_of_a_missing_neighbour(shadow):
    features = torch.tensor([[-3.0, 1.0], [-2.0, -5.0], [7.0, 7.0]])
    neighbours = torch.tensor([[0, 3 if shadow else 1]])
    expected = [[0.0, 1.0]] if shadow else [[-2.0, 1.0]]
    assert max_pooled(features, neighbours).tolist() == expected
