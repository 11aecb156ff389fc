"""Convolution of point clouds by kernel points (Thomas et al.: KPConv, ICCV 2019).

Rigid kernel points, linear influence, influences summed, and the division by the number of
neighbours that D3Feat brought in and that Predator and GeoTransformer kept.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

#: Points of a kernel in all published networks.
KERNEL_SIZE = 15

# Points convolved at a time; the influences of all would need gigabytes.
_CHUNK = 8192


class KernelPointConvolution(nn.Module):
    """A convolution by weights that sit on points around a point.

    A checkpoint brings the kernel points along; those of a new convolution are spread evenly.

    Attributes:
        weights: (k, inside, outside).
        kernel_points: (k, 3), metres.
        extent: distance at which a kernel point has no influence any more, metres.
    """

    kernel_points: Tensor

    def __init__(self, inside: int, outside: int, radius: float, extent: float) -> None:
        """Of channels `inside` to `outside`, in neighbourhoods of `radius` metres."""
        super().__init__()
        self.extent = extent
        self.weights = nn.Parameter(torch.empty(KERNEL_SIZE, inside, outside))
        nn.init.kaiming_uniform_(self.weights, a=math.sqrt(5))
        self.register_buffer("kernel_points", _spread(radius))

    def forward(
        self, queries: Tensor, supports: Tensor, neighbours: Tensor, features: Tensor
    ) -> Tensor:
        """Features (n, outside) of the queries.

        Args:
            queries: (n, 3), metres.
            supports: (m, 3), metres.
            neighbours: (n, h) int64, indices of supports; m where there is none.
            features: (m, inside), of the supports.
        """
        supports = torch.cat((supports, supports.new_full((1, 3), 1e6)))
        features = with_shadow(features)
        chunks = zip(torch.split(queries, _CHUNK), torch.split(neighbours, _CHUNK), strict=True)
        return torch.cat(
            [self._convolved(each, supports[near], features[near]) for each, near in chunks]
        )

    def _convolved(self, queries: Tensor, positions: Tensor, features: Tensor) -> Tensor:
        """(n, outside) of queries (n, 3) by positions (n, h, 3) and features (n, h, inside)."""
        influence = self._influence(positions - queries[:, None])
        weighted = influence.transpose(1, 2) @ features
        summed = weighted.flatten(1) @ self.weights.flatten(0, 1)
        counted = (features.sum(dim=2) > 0).sum(dim=1, keepdim=True)
        return summed / counted.clamp(min=1)

    def _influence(self, offsets: Tensor) -> Tensor:
        """Of each kernel point on each neighbour, (n, h, k), of offsets (n, h, 3)."""
        squared = sum(
            (offsets[:, :, axis, None] - self.kernel_points[:, axis]).square() for axis in range(3)
        )
        return (1 - torch.sqrt(torch.as_tensor(squared)) / self.extent).clamp(min=0)


def with_shadow(features: Tensor) -> Tensor:
    """Features (m + 1, c): those of m points, and the zeros of a missing neighbour."""
    return torch.cat((features, torch.zeros_like(features[:1])))


def max_pooled(features: Tensor, neighbours: Tensor) -> Tensor:
    """The largest of the neighbours' features (m, c), per channel, (n, c).

    A missing neighbour counts as zero, as it did when the networks were trained.

    Args:
        features: (m, c).
        neighbours: (n, h) int64, indices; m where there is none.
    """
    features = with_shadow(features)
    return torch.cat([features[near].amax(dim=1) for near in torch.split(neighbours, _CHUNK)])


def _spread(radius: float) -> Tensor:
    """A centre and a spiral on the sphere of 2/3 of the radius, (KERNEL_SIZE, 3) float32."""
    count = KERNEL_SIZE - 1
    steps = torch.arange(count, dtype=torch.float64)
    height = 1 - (2 * steps + 1) / count
    angle = steps * math.pi * (3 - math.sqrt(5))
    flat = torch.sqrt(1 - height.square())
    sphere = torch.stack((flat * angle.cos(), flat * angle.sin(), height), dim=1)
    points = torch.cat((torch.zeros(1, 3, dtype=torch.float64), sphere * 2 / 3))
    return (radius * points).float()
