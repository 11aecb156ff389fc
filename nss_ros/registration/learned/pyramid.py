"""Ever coarser point clouds with their neighbourhoods, on which kernel point convolutions work.

All networks of the family (KPConv, D3Feat, Predator, GeoTransformer) are trained on pyramids made
by one rule: the points of a level are the barycentres of a grid twice as coarse as that of the
level before, and neighbourhoods grow with the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from nss_ros.fragment import Points

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Level:
    """One level of a pyramid of clouds that are stacked one after the other.

    Neighbourhoods are of one cloud each. Their indices are nearest first, and filled up with
    the number of points that they index.

    Attributes:
        points: (n, 3) float32, metres.
        lengths: points of each cloud; they sum to n.
        neighbours: (n, k) int64, of each point among `points`.
        pooling: (m, k) int64, of each point of the next level among `points`; None on the last.
        upsampling: (n,) int64, point of the next level that is nearest; None on the last.
    """

    points: Tensor
    lengths: tuple[int, ...]
    neighbours: Tensor
    pooling: Tensor | None
    upsampling: Tensor | None


def pyramid(
    clouds: Sequence[Points],
    voxel_size: float,
    radius: float,
    limits: Sequence[int],
    device: torch.device,
) -> list[Level]:
    """The levels of clouds, the finest first.

    Args:
        clouds: (n, 3) float32 each, not empty, already subsampled to `voxel_size`, metres.
        voxel_size: of the finest level, metres; doubles from level to level.
        radius: of its neighbourhoods, metres; doubles from level to level.
        limits: most neighbours of a point, of each level.
        device: where the tensors go.
    """
    levels: list[Level] = []
    fine = list(clouds)
    for depth, limit in enumerate(limits):
        scale = 2**depth
        pooling = upsampling = None
        coarse: list[Points] = []
        if depth + 1 < len(limits):
            coarse = [grid_subsampled(cloud, 2 * scale * voxel_size) for cloud in fine]
            pooling = _tensor(_stacked(coarse, fine, scale * radius, limit), device)
            nearest = _stacked(fine, coarse, 2 * scale * radius, 1)
            upsampling = _tensor(nearest[:, 0], device)
        neighbours = _tensor(_stacked(fine, fine, scale * radius, limit), device)
        points = _tensor(np.concatenate(fine), device)
        lengths = tuple(len(cloud) for cloud in fine)
        levels.append(Level(points, lengths, neighbours, pooling, upsampling))
        fine = coarse
    return levels


def grid_subsampled(points: Points, voxel_size: float) -> Points:
    """The barycentre of every occupied voxel, (m, 3) float32.

    The voxels, and the barycentres bit for bit, are those of the `grid_subsampling` in C++ that
    comes with the official networks, which calculates with float32: its voxels start at the
    cloud's lowest corner, rounded down. Only the order differs: here it is by z, then y, then x,
    there it is that of a hash table.

    Args:
        points: (n, 3) float32, metres.
        voxel_size: edge of the voxels, metres.
    """
    if len(points) == 0:
        return points
    size = np.float32(voxel_size)
    origin = np.floor(points.min(axis=0) * (np.float32(1) / size)) * size
    cells = np.floor((points - origin) / size).astype(np.int64)
    order = np.lexsort(cells.T)
    cells, points = cells[order], points[order]
    starts = np.ones(len(points), dtype=bool)
    starts[1:] = (cells[1:] != cells[:-1]).any(axis=1)
    voxels = np.cumsum(starts) - 1
    counts = np.bincount(voxels)
    sums = np.zeros((3, len(counts)), dtype=np.float32)
    for axis in range(3):  # `at` adds point by point, as the sums of C++ were made
        np.add.at(sums[axis], voxels, points[:, axis])
    return np.ascontiguousarray((sums * (1 / counts).astype(np.float32)).T)


def radius_neighbours(queries: Points, supports: Points, radius: float, limit: int) -> Indices:
    """Supports nearer than a radius to each query, nearest first, (n, k) int64.

    As many columns as the fullest neighbourhood needs, `limit` at most; missing neighbours are
    `len(supports)`.

    Args:
        queries: (n, 3), metres.
        supports: (m, 3), metres; not empty.
        radius: metres, exclusive.
        limit: most neighbours.
    """
    ranks = np.arange(1, min(limit, len(supports)) + 1)
    _, found = cKDTree(supports).query(queries, k=ranks, distance_upper_bound=radius)
    width = int((found < len(supports)).sum(axis=1).max(initial=1))
    return np.ascontiguousarray(found[:, :width], dtype=np.int64)


def _stacked(
    queries: Sequence[Points], supports: Sequence[Points], radius: float, limit: int
) -> Indices:
    """Neighbours within each cloud, as indices into the stack of all."""
    total = sum(map(len, supports))
    found = [
        radius_neighbours(query, support, radius, limit)
        for query, support in zip(queries, supports, strict=True)
    ]
    width = max(each.shape[1] for each in found)
    stack = np.full((sum(map(len, found)), width), total, dtype=np.int64)
    row = first = 0
    for each, support in zip(found, supports, strict=True):
        indices = np.where(each < len(support), each + first, total)
        stack[row : row + len(each), : each.shape[1]] = indices
        row += len(each)
        first += len(support)
    return stack


def _tensor(array: NDArray[np.generic], device: torch.device) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to(device)
