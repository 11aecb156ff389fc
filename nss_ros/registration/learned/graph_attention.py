"""Exchange between two coarse clouds: graph convolution within, attention across.

Predator's overlap attention (Huang et al., CVPR 2021, section 3.2): edge convolutions as of DGCNN
(Wang et al. 2019) and message passing as of SuperGlue (Sarlin et al. 2020). Tensors are named as
in the authors' checkpoints. Features are (1, c, n).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

_NEIGHBOURS = 10
_HEADS = 4
_SLOPE = 0.2


class GraphNetwork(nn.Module):
    """Within each cloud, across, and within again."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            [EdgeConvolution(channels), CrossAttention(channels), EdgeConvolution(channels)]
        )

    def forward(
        self, points: Sequence[Tensor], features: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Features (1, c, n) of two clouds of points (n, 3)."""
        before, across, after = self.layers
        near = [nearest(each) for each in points]
        source, target = (before(*each) for each in zip(features, near, strict=True))
        source = source + across(source, target)
        target = target + across(target, source)  # of a source that has already seen it
        return after(source, near[0]), after(target, near[1])


def nearest(points: Tensor) -> Tensor:
    """The ten nearest other points of each, as many as there are, (n, k) int64.

    A single point is its own neighbour.

    Args:
        points: (n, 3), metres; not empty.
    """
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    count = min(_NEIGHBOURS + 1, len(points))
    found = distances.topk(count, dim=1, largest=False).indices
    return found[:, 1:] if len(points) > 1 else found


class EdgeConvolution(nn.Module):
    """Two convolutions over the edges to the nearest points, then one over both results."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(2 * channels, channels, 1, bias=False)
        self.conv2 = nn.Conv2d(2 * channels, 2 * channels, 1, bias=False)
        self.conv3 = nn.Conv2d(4 * channels, channels, 1, bias=False)

    def forward(self, features: Tensor, near: Tensor) -> Tensor:
        """Features (1, c, n), of those of points with neighbours (n, k)."""
        first = _over_edges(self.conv1, features, near)
        second = _over_edges(self.conv2, first, near)
        joined = torch.cat((features, first, second), dim=1)
        hidden = functional.conv1d(joined, self.conv3.weight[..., 0])
        return functional.leaky_relu(_normalised(hidden), _SLOPE)


def _over_edges(convolution: nn.Conv2d, features: Tensor, near: Tensor) -> Tensor:
    """The largest of a convolution of all edges of a point, (1, c, n).

    An edge has the features of its point and the difference to its neighbour's. The convolution
    is linear, so it is made once for each point and not for each edge.
    """
    own, difference = convolution.weight[..., 0].chunk(2, dim=1)
    points = functional.conv1d(features, own - difference)
    neighbours = functional.conv1d(features, difference)
    edges = points[..., None] + neighbours[:, :, near]
    return functional.leaky_relu(_normalised(edges), _SLOPE).amax(dim=3)


class CrossAttention(nn.Module):
    """What a cloud learns from another one."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attn = MultiHeadAttention(channels)
        self.mlp = nn.Sequential(
            nn.Conv1d(2 * channels, 2 * channels, 1),
            ChannelNormalisation(),
            nn.ReLU(),
            nn.Conv1d(2 * channels, channels, 1),
        )

    def forward(self, features: Tensor, others: Tensor) -> Tensor:
        """A message (1, c, n) to features (1, c, n) from others (1, c, m)."""
        message: Tensor = self.mlp(torch.cat((features, self.attn(features, others)), dim=1))
        return message


class MultiHeadAttention(nn.Module):
    """Attention by four heads, whose channels alternate."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.merge = nn.Conv1d(channels, channels, 1)
        self.proj = nn.ModuleList(nn.Conv1d(channels, channels, 1) for _ in range(3))

    def forward(self, features: Tensor, others: Tensor) -> Tensor:
        """Means (1, c, n) of others (1, c, m), weighted for features (1, c, n)."""
        query, key, value = (
            _heads(layer(each))
            for layer, each in zip(self.proj, (features, others, others), strict=True)
        )
        found = functional.scaled_dot_product_attention(query, key, value)
        merged: Tensor = self.merge(found.permute(2, 0, 1).flatten(0, 1)[None])
        return merged


def _heads(channels: Tensor) -> Tensor:
    """(1, c, n) as (heads, n, c / heads)."""
    return channels[0].reshape(-1, _HEADS, channels.shape[2]).permute(1, 2, 0)


class ChannelNormalisation(nn.Module):
    """As `_normalised`, a layer."""

    def forward(self, features: Tensor) -> Tensor:
        """(1, c, n) to (1, c, n)."""
        return _normalised(features)


def _normalised(features: Tensor) -> Tensor:
    """Every channel of (1, c, ...) shifted and scaled to mean 0 and variance 1."""
    over = tuple(range(2, features.ndim))
    variance, mean = torch.var_mean(features, dim=over, correction=0, keepdim=True)
    return (features - mean) * torch.rsqrt(variance + 1e-5)
