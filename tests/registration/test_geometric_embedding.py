import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nss_ros.registration.learned.geometric_embedding import (
    Curve,
    GeometricEmbedding,
    SinusoidalEmbedding,
)

CHANNELS = 8
SIGMA = 0.2


@pytest.fixture(autouse=True)
def _no_gradients():
    with torch.no_grad():
        yield


def embedding(seed=0):
    torch.manual_seed(seed)
    return GeometricEmbedding(CHANNELS, SIGMA)


def points(count, seed=0):
    random = np.random.default_rng(seed)
    return torch.from_numpy(random.uniform(-2, 2, (count, 3)).astype(np.float32))


def sinusoids(number):
    """Sine and cosine in turns, written out."""
    values = []
    for channel in range(0, CHANNELS, 2):
        phase = number / 10000 ** (channel / CHANNELS)
        values += [math.sin(phase), math.cos(phase)]
    return np.array(values)


def projected(layer, number):
    weight, bias = (each.double().numpy() for each in (layer.weight, layer.bias))
    return weight @ sinusoids(number) + bias


def angle(one, other):
    """Between two vectors, degrees; zero where one has no length."""
    lengths = np.linalg.norm(one) * np.linalg.norm(other)
    return np.degrees(np.arccos(np.clip(one @ other / lengths, -1, 1))) if lengths else 0.0


def written_out(network, cloud, first, second):
    """The embedding of one pair, as the paper has it."""
    cloud = cloud.double().numpy()
    distances = np.linalg.norm(cloud - cloud[first], axis=1)
    line = cloud[second] - cloud[first]
    angular = [
        projected(network.proj_a, angle(cloud[neighbour] - cloud[first], line) / 15)
        for neighbour in np.argsort(distances)[1:4]
    ]
    return projected(network.proj_d, distances[second] / SIGMA) + np.max(angular, axis=0)


def test_sinusoids_are_in_turns():
    numbers = torch.tensor([0.0, 1.5, 40.0])
    expected = np.stack([sinusoids(float(number)) for number in numbers])
    assert np.allclose(SinusoidalEmbedding(CHANNELS)(numbers), expected, atol=1e-5)


@pytest.mark.parametrize("count", [6, 110])  # by the layers themselves, and by tables
def test_pairs_are_embedded_as_the_paper_says(count):
    network, cloud = embedding(), points(count)
    structure = network(cloud)
    assert (structure.of_angle.table is None) == (count == 6)
    rows = structure.rows(slice(1, 4))
    assert rows.shape == (3, count, CHANNELS)
    for first, second in ((1, 0), (1, 1), (2, 5), (3, 2), (3, count - 1)):
        expected = written_out(network, cloud, first, second)
        assert np.allclose(rows[first - 1, second], expected, atol=1e-4)


def test_a_table_is_as_exact_as_float32():
    network = embedding()
    table = Curve.of(network.embedding, network.proj_d, 30.0, 10**6)
    plain = Curve.of(network.embedding, network.proj_d, 30.0, 10)
    assert table.table is not None
    assert plain.table is None
    numbers = torch.linspace(0, 30, 40_000).view(2, -1)
    assert torch.allclose(table(numbers), plain(numbers), rtol=0, atol=5e-6)


def test_clouds_that_reach_far_have_no_table():
    cloud = points(300) * 1000
    assert embedding()(cloud).of_distance.table is None


def test_it_does_not_change_when_all_move_rigidly():
    network, cloud = embedding(), points(40)
    turn = torch.from_numpy(Rotation.random(rng=np.random.default_rng(1)).as_matrix()).float()
    moved = cloud @ turn.T + torch.tensor([0.5, -1.0, 2.0])
    before, after = (network(each).rows(slice(0, 40)) for each in (cloud, moved))
    assert torch.allclose(before, after, atol=1e-3)
    stretched = network(cloud * 1.1).rows(slice(0, 40))
    assert not torch.allclose(before, stretched, atol=1e-2)
