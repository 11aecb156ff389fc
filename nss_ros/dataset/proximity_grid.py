"""A grid that tells for most positions whether a cloud has a point within a distance of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform

FAR, NEAR, MET = 0, 1, 2
"""Surely no point within the distance; perhaps one; surely one."""

# Cells are cubes of the distance over 1.5 * sqrt(3), a little less. Two points of one cell, or of
# two with a common face, are then nearer than the distance. Points that are four cells apart along
# an axis have three cells, more than the distance, between them.
_CELLS_PER_DISTANCE = 1.5 * 3**0.5 * (1 + 1e-9)
_REACH = 3
# A fragment has about 40 cells per point. With many more a search is faster.
_MOST_CELLS, _MOST_CELLS_PER_POINT = 2**18, 256


@dataclass(frozen=True, slots=True, eq=False)
class ProximityGrid:
    """The grid of one cloud and one distance.

    Attributes:
        origin: (3,) of the grid, metres, frame of the cloud.
        size: of its cells, metres.
        labels: (nx, ny, nz) uint8 FAR, NEAR or MET; FAR in the outermost layers.
    """

    origin: NDArray[np.float64]
    size: float
    labels: NDArray[np.uint8]

    def at(self, T_cloud_source: Transform, axes: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Labels (n,) at positions.

        Args:
            T_cloud_source: maps the positions to the frame of the cloud.
            axes: (3, n) positions, metres, a row per axis.
        """
        offset = (T_cloud_source[:3, 3] - self.origin) / self.size
        cells = (T_cloud_source[:3, :3] / self.size) @ axes
        cells += offset[:, None]
        # Beyond the grid is as in its outermost layers.
        np.maximum(cells, 0, out=cells)
        np.minimum(cells, np.array(self.labels.shape)[:, None] - 1, out=cells)
        x, y, z = cells.astype(np.int32)
        _, rows, columns = self.labels.shape
        return np.asarray(self.labels.reshape(-1).take((x * rows + y) * columns + z))


def proximity_grid(axes: NDArray[np.float64], distance: float) -> ProximityGrid | None:
    """The grid of a cloud; None if it has no points, or far too few for its extent.

    Args:
        axes: (3, n) points, metres, a row per axis.
        distance: metres.
    """
    if axes.shape[1] == 0:
        return None
    size = distance / _CELLS_PER_DISTANCE
    origin = axes.min(axis=1) - (_REACH + 1.5) * size
    extent = np.floor((axes.max(axis=1) - origin) / size) + _REACH + 2
    if extent.prod() > max(_MOST_CELLS, _MOST_CELLS_PER_POINT * axes.shape[1]):
        return None
    occupied = np.zeros(extent.astype(np.int64), dtype=np.uint8)
    occupied[tuple(((axes - origin[:, None]) / size).astype(np.int32))] = 1
    return ProximityGrid(origin, size, _spread(occupied, _REACH) + _with_neighbours(occupied))


def _with_neighbours(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The cells, and those that have a face in common with them."""
    result = cells.copy()
    for axis in range(3):
        one, other = _shifted(axis, 1)
        result[one] |= cells[other]
        result[other] |= cells[one]
    return result


def _spread(cells: NDArray[np.uint8], reach: int) -> NDArray[np.uint8]:
    """All cells that are no more than so many away along every axis."""
    for axis in range(3):
        result = cells.copy()
        for step in range(1, reach + 1):
            one, other = _shifted(axis, step)
            result[one] |= cells[other]
            result[other] |= cells[one]
        cells = result
    return cells


def _shifted(axis: int, step: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Indices of all cells but the first, and of all but the last, along an axis."""
    before = (slice(None),) * axis
    return (*before, slice(step, None)), (*before, slice(None, -step))
