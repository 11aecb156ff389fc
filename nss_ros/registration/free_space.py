"""Free space that contradicts an alignment.

A scanner sees through the air: everything nearer than the surface it measured in a direction is
known to be empty. Surfaces of one fragment that an alignment puts there contradict it, however
many others fit; a room shifted by one bay of columns is the usual case. Directions in which
nothing was measured say nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from nss_ros.geometry import inverse, spherical

_BIN = np.radians(2.0)
_ROWS, _COLUMNS = 90, 180
# A surface must lie this much before the measured one: sensor noise, voxels, tilt and thin parts.
_MARGIN = 0.25

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RangeImage:
    """How far a scanner at the origin saw in each direction.

    Attributes:
        nearest: (90, 180) float64, metres, elevation by azimuth in bins of 2 deg; the least of a
            bin and its neighbours, so that edges do no harm; infinite where nothing was measured.
        farthest: the same with the most of a bin and its neighbours; minus infinite where nothing
            was measured.
    """

    nearest: Array
    farthest: Array

    @classmethod
    def of(cls, points: NDArray[np.floating]) -> RangeImage:
        """The range image of a fragment's points (n, 3) in its sensor frame."""
        rows, columns, distances = _directions(np.asarray(points, dtype=np.float64))
        nearest = np.full((_ROWS, _COLUMNS), np.inf)
        farthest = np.full((_ROWS, _COLUMNS), -np.inf)
        np.minimum.at(nearest, (rows, columns), distances)
        np.maximum.at(farthest, (rows, columns), distances)
        mode = ("nearest", "wrap")
        return cls(minimum_filter(nearest, 3, mode=mode), maximum_filter(farthest, 3, mode=mode))

    def empty(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of points (..., 3) was seen to be empty, (...)."""
        return self._emptiness(*_directions(points))

    def compare(self, points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """How many of points (..., n, 3) lie in free space, and how many on a surface, (...)."""
        rows, columns, distances = _directions(points)
        free = self._emptiness(rows, columns, distances)
        behind = distances > self.farthest[rows, columns] + _MARGIN
        return np.count_nonzero(free, axis=-1), np.count_nonzero(~free & ~behind, axis=-1)

    def _emptiness(
        self, rows: NDArray[np.intp], columns: NDArray[np.intp], distances: Array
    ) -> NDArray[np.bool_]:
        nearest = self.nearest[rows, columns]
        return np.asarray(np.isfinite(nearest) & (distances < nearest - _MARGIN))


@dataclass(frozen=True, slots=True)
class View:
    """What the scanner of a levelled fragment saw; its frame is that of the sensor.

    Attributes:
        points: (n, 3) float64, some of the fragment's points.
        image: of all of them.
    """

    points: Array
    image: RangeImage


def conflicts(source: View, target: View, transforms: Array) -> Array:
    """Share of the points that the other scanner should see, but which lie in its free space.

    Points behind what the other scanner saw are hidden from it and do not count: of those that
    count, the others lie on its surfaces. So an alignment that shares no surface is all conflict.

    Args:
        source: what the source saw.
        target: what the target saw.
        transforms: (k, 4, 4), each `T_target_source`.

    Returns:
        (k,) in 0..1; 1 when nothing counts.
    """
    free, shared = target.image.compare(_moved(transforms, source.points))
    backward = np.array([inverse(transform) for transform in transforms]).reshape(-1, 4, 4)
    free_back, shared_back = source.image.compare(_moved(backward, target.points))
    return np.asarray((free + free_back + 1) / (free + free_back + shared + shared_back + 1))


def _moved(transforms: Array, points: Array) -> Array:
    """Points (n, 3) moved by transforms (k, 4, 4), (k, n, 3)."""
    turned = np.einsum("kij,nj->kni", transforms[:, :3, :3], points)
    return np.asarray(turned + transforms[:, None, :3, 3])


def _directions(points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Row and column of the range image, and distance, of points (..., 3)."""
    distances, azimuth, elevation = spherical(points)
    columns = np.minimum((azimuth / _BIN).astype(np.intp), _COLUMNS - 1)
    rows = np.minimum((elevation / _BIN).astype(np.intp), _ROWS - 1)
    return rows, columns, distances
