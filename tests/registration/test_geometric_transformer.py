import math

import numpy as np
import pytest
import torch

from nss_ros.registration.learned import geometric_transformer
from nss_ros.registration.learned.geometric_embedding import GeometricEmbedding
from nss_ros.registration.learned.geometric_transformer import (
    ConditionalTransformer,
    CrossAttention,
    RelativeAttention,
)

CHANNELS, HEADS = 16, 4
WIDTH = CHANNELS // HEADS


@pytest.fixture(autouse=True)
def _no_gradients():
    torch.manual_seed(0)
    with torch.no_grad():
        yield


def structure_of(count):
    return GeometricEmbedding(CHANNELS, 0.2)(torch.rand(count, 3) * 3)


def softmax(values):
    shares = np.exp(values - values.max())
    return shares / shares.sum()


def attended(network, features, memory, structure=None):
    """Attention pair by pair and head by head."""
    features, memory = (each.double() for each in (features, memory))
    network = network.double()
    query, key, value = network.proj_q(features), network.proj_k(memory), network.proj_v(memory)
    gathered = np.zeros((len(features), CHANNELS))
    for head in range(HEADS):
        mine = slice(head * WIDTH, (head + 1) * WIDTH)
        for first in range(len(features)):
            scores = np.array([float(query[first, mine] @ other) for other in key[:, mine]])
            if structure is not None:
                places = network.proj_p(structure[first].double())[:, mine]
                scores += np.array([float(query[first, mine] @ place) for place in places])
            gathered[first, mine] = softmax(scores / math.sqrt(WIDTH)) @ value[:, mine].numpy()
    return gathered


@pytest.mark.parametrize("pairs", [1, 25, 10**6])  # embedded at a time
def test_relative_attention_pair_by_pair(pairs, monkeypatch):
    monkeypatch.setitem(geometric_transformer._PAIRS, "cpu", pairs)
    network, features, structure = (
        RelativeAttention(CHANNELS),
        torch.randn(11, 16),
        structure_of(11),
    )
    network.proj_p.bias += 1
    found = network(features, structure)
    expected = attended(network, features, features, structure.rows(slice(0, 11)))
    assert np.allclose(found, expected, atol=1e-5)
    assert not np.allclose(found, attended(network, features, features), atol=1e-3)


def test_cross_attention_pair_by_pair():
    network, features, others = CrossAttention(CHANNELS), torch.randn(5, 16), torch.randn(7, 16)
    found = network(features, others)
    assert np.allclose(found, attended(network, features, others), atol=1e-5)


def test_the_source_attends_to_what_the_target_has_become():
    network = ConditionalTransformer(CHANNELS)
    structures = structure_of(5), structure_of(6)
    target, source = torch.randn(5, CHANNELS), torch.randn(6, CHANNELS)
    found = network(target, source, structures)
    for number, layer in enumerate(network.layers):
        if number % 2 == 0:
            target, source = layer(target, structures[0]), layer(source, structures[1])
        else:
            before = target
            target = layer(target, source)
            simultaneous = layer(source, before)
            source = layer(source, target)
    assert torch.equal(found[0], target)
    assert torch.equal(found[1], source)
    assert not torch.allclose(source, simultaneous, atol=1e-4)
