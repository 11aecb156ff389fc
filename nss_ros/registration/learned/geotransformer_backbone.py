"""Features of points and superpoints by kernel point convolutions (Qin et al., CVPR 2022, 3.1).

Normalisation is by groups of channels over all points of both clouds, so features of a fragment
are of a pair.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nss_ros.registration.learned.kernel_points import (
    KernelPointConvolution,
    max_pooled,
    with_shadow,
)
from nss_ros.registration.learned.pyramid import Level

#: Radius of a neighbourhood, and distance at which a kernel point has no influence, in voxels.
RADIUS, EXTENT = 2.5, 2.0

_WIDTH = 64
_GROUPS = 32
_SLOPE = 0.1


class BiasedConvolution(KernelPointConvolution):
    """A kernel point convolution that adds a bias."""

    def __init__(self, inside: int, outside: int, voxel_size: float) -> None:
        """On points of a voxel size in metres."""
        super().__init__(inside, outside, RADIUS * voxel_size, EXTENT * voxel_size)
        self.bias = nn.Parameter(torch.zeros(outside))

    def forward(
        self, queries: Tensor, supports: Tensor, neighbours: Tensor, features: Tensor
    ) -> Tensor:
        """As `KernelPointConvolution`."""
        return super().forward(queries, supports, neighbours, features) + self.bias


class Norm(nn.Module):
    """Group normalisation over all points."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(_GROUPS, channels)

    def forward(self, features: Tensor) -> Tensor:
        """(n, channels) of (n, channels)."""
        normed: Tensor = self.norm(features.T[None])
        return normed[0].T


class UnaryBlock(nn.Module):
    """A linear layer, normalised."""

    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.mlp = nn.Linear(inside, outside)
        self.norm = Norm(outside)

    def forward(self, features: Tensor) -> Tensor:
        """(n, outside) of (n, inside)."""
        normed: Tensor = self.norm(self.mlp(features))
        return normed


class LastBlock(nn.Module):
    """A linear layer."""

    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.mlp = nn.Linear(inside, outside)

    def forward(self, features: Tensor) -> Tensor:
        """(n, outside) of (n, inside)."""
        projected: Tensor = self.mlp(features)
        return projected


class ConvolutionBlock(nn.Module):
    """A convolution within a level."""

    def __init__(self, inside: int, outside: int, voxel_size: float) -> None:
        super().__init__()
        self.KPConv = BiasedConvolution(inside, outside, voxel_size)
        self.norm = Norm(outside)

    def forward(self, level: Level, features: Tensor) -> Tensor:
        """(n, outside) of (n, inside)."""
        convolved = self.KPConv(level.points, level.points, level.neighbours, features)
        return _activated(self.norm(convolved))


class ResidualBlock(nn.Module):
    """A narrow convolution beside a shortcut, within a level or from one to the next."""

    def __init__(self, inside: int, outside: int, voxel_size: float) -> None:
        super().__init__()
        middle = outside // 4
        self.unary1 = UnaryBlock(inside, middle)
        self.KPConv = BiasedConvolution(middle, middle, voxel_size)
        self.norm_conv = Norm(middle)
        self.unary2 = UnaryBlock(middle, outside)
        self.unary_shortcut = nn.Identity() if inside == outside else UnaryBlock(inside, outside)

    def forward(self, level: Level, features: Tensor, coarser: Level | None = None) -> Tensor:
        """(n, outside) of (m, inside) on a level, for it or for the points of a coarser one."""
        queries, neighbours, shortcut = level.points, level.neighbours, features
        if coarser is not None:
            assert level.pooling is not None
            queries, neighbours = coarser.points, level.pooling
            shortcut = max_pooled(features, neighbours)
        hidden = _activated(self.unary1(features))
        hidden = self.KPConv(queries, level.points, neighbours, hidden)
        hidden = self.unary2(_activated(self.norm_conv(hidden)))
        return _activated(hidden + self.unary_shortcut(shortcut))


class Backbone(nn.Module):
    """An encoder of four levels, and a decoder back to the second.

    Args:
        voxel_size: of the finest level, metres.
    """

    def __init__(self, voxel_size: float) -> None:
        super().__init__()
        self.encoder1_1 = ConvolutionBlock(1, _WIDTH, voxel_size)
        self.encoder1_2 = ResidualBlock(_WIDTH, 2 * _WIDTH, voxel_size)
        self.encoder2_1 = ResidualBlock(2 * _WIDTH, 2 * _WIDTH, voxel_size)
        self.encoder2_2 = ResidualBlock(2 * _WIDTH, 4 * _WIDTH, 2 * voxel_size)
        self.encoder2_3 = ResidualBlock(4 * _WIDTH, 4 * _WIDTH, 2 * voxel_size)
        self.encoder3_1 = ResidualBlock(4 * _WIDTH, 4 * _WIDTH, 2 * voxel_size)
        self.encoder3_2 = ResidualBlock(4 * _WIDTH, 8 * _WIDTH, 4 * voxel_size)
        self.encoder3_3 = ResidualBlock(8 * _WIDTH, 8 * _WIDTH, 4 * voxel_size)
        self.encoder4_1 = ResidualBlock(8 * _WIDTH, 8 * _WIDTH, 4 * voxel_size)
        self.encoder4_2 = ResidualBlock(8 * _WIDTH, 16 * _WIDTH, 8 * voxel_size)
        self.encoder4_3 = ResidualBlock(16 * _WIDTH, 16 * _WIDTH, 8 * voxel_size)
        self.decoder3 = UnaryBlock(24 * _WIDTH, 8 * _WIDTH)
        self.decoder2 = LastBlock(12 * _WIDTH, 4 * _WIDTH)

    def forward(self, levels: list[Level]) -> tuple[Tensor, Tensor]:
        """Features of the points of the second level (n, 256), and of the fourth (m, 1024)."""
        first, second, third, fourth = levels
        features = self.encoder1_1(first, torch.ones_like(first.points[:, :1]))
        features = self.encoder2_1(first, self.encoder1_2(first, features), second)
        fine = self.encoder2_3(second, self.encoder2_2(second, features))
        features = self.encoder3_1(second, fine, third)
        middle = self.encoder3_3(third, self.encoder3_2(third, features))
        features = self.encoder4_1(third, middle, fourth)
        coarse = self.encoder4_3(fourth, self.encoder4_2(fourth, features))
        features = torch.cat((_spread(coarse, third), middle), dim=1)
        features = _activated(self.decoder3(features))
        features = torch.cat((_spread(features, second), fine), dim=1)
        return self.decoder2(features), coarse


def _activated(features: Tensor) -> Tensor:
    return nn.functional.leaky_relu(features, _SLOPE)


def _spread(features: Tensor, finer: Level) -> Tensor:
    """The features (m, c) of the next level at the points of a finer one, (n, c)."""
    assert finer.upsampling is not None
    return with_shadow(features)[finer.upsampling]
