import pytest
import torch
from torch.nn import functional

from nss_ros.registration.learned.graph_attention import (
    CrossAttention,
    EdgeConvolution,
    GraphNetwork,
    MultiHeadAttention,
    nearest,
)

CHANNELS = 16


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def points_and_features(count):
    return torch.rand(count, 3), torch.randn(1, CHANNELS, count)


def test_nearest_are_the_others_in_order():
    points, _ = points_and_features(50)
    distances = torch.linalg.norm(points[:, None] - points, dim=2)
    assert torch.equal(nearest(points), distances.argsort(dim=1)[:, 1:11])


@pytest.mark.parametrize(("count", "neighbours"), [(1, 1), (2, 1), (7, 6)])
def test_clouds_of_few_points(count, neighbours):
    points, features = points_and_features(count)
    assert nearest(points).shape == (count, neighbours)
    found = GraphNetwork(CHANNELS)((points, points), (features, features))
    assert all(each.shape == features.shape and each.isfinite().all() for each in found)


def test_an_edge_convolution_against_explicit_edges():
    points, features = points_and_features(30)
    layer = EdgeConvolution(CHANNELS)
    near = nearest(points)

    def over_edges(convolution, values):
        own = values[..., None].expand(-1, -1, -1, near.shape[1])
        edges = convolution(torch.cat((own, values[:, :, near] - own), dim=1))
        return functional.leaky_relu(functional.instance_norm(edges), 0.2).amax(dim=3)

    first = over_edges(layer.conv1, features)
    second = over_edges(layer.conv2, first)
    last = layer.conv3(torch.cat((features, first, second), dim=1)[..., None])
    expected = functional.leaky_relu(functional.instance_norm(last), 0.2)[..., 0]
    assert torch.allclose(layer(features, near), expected, atol=1e-5)


def test_attention_against_one_query_at_a_time():
    _, features = points_and_features(9)
    _, others = points_and_features(13)
    layer = MultiHeadAttention(CHANNELS)
    query, key, value = (
        linear(each)[0] for linear, each in zip(layer.proj, (features, others, others), strict=True)
    )
    means = torch.zeros(CHANNELS, 9)
    for head in range(4):
        channels = slice(head, None, 4)
        for index in range(9):
            likeness = key[channels].T @ query[channels, index] / (CHANNELS / 4) ** 0.5
            means[channels, index] = value[channels] @ likeness.softmax(dim=0)
    assert torch.allclose(layer(features, others), layer.merge(means[None]), atol=1e-5)


def test_a_message_depends_on_no_order_of_the_others():
    _, features = points_and_features(9)
    _, others = points_and_features(13)
    layer = CrossAttention(CHANNELS)
    order = torch.randperm(13)
    assert torch.allclose(layer(features, others), layer(features, others[..., order]), atol=1e-5)


def test_points_may_be_in_any_order():
    clouds = [points_and_features(count) for count in (25, 31)]
    orders = [torch.randperm(len(points)) for points, _ in clouds]
    network = GraphNetwork(CHANNELS)
    found = network(*zip(*clouds, strict=True))
    mixed = [(p[order], f[..., order]) for (p, f), order in zip(clouds, orders, strict=True)]
    again = network(*zip(*mixed, strict=True))
    for one, other, order in zip(found, again, orders, strict=True):
        assert torch.allclose(one[..., order], other, atol=1e-4)


def test_each_cloud_hears_of_the_other():
    (points, features), (others, theirs) = points_and_features(25), points_and_features(31)
    network = GraphNetwork(CHANNELS)
    source, target = network((points, others), (features, theirs))
    again, changed = network((points, others), (features, theirs + torch.randn_like(theirs)))
    assert (source - again).abs().max() > 1e-3
    assert (target - changed).abs().max() > 1e-3
