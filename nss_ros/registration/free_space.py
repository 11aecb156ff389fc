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

# Size of a bin, degrees, and how much a surface must lie before the measured one: sensor noise,
# voxels, tilt and thin parts.
_BIN, _MARGIN = 2.0, 0.25

Array = NDArray[np.float64]
_Cells = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True, slots=True)
class RangeImage:
    """How far a scanner at the origin saw in each direction.

    Attributes:
        nearest: (r, 2 r) float64, metres, elevation by azimuth in bins of 180 / r deg; the least
            of a bin and its neighbours, so that edges do no harm; infinite where nothing was
            measured.
        farthest: the same with the most of a bin and its neighbours; minus infinite where nothing
            was measured.
        margin: how much nearer than that a point must be to lie in free space, or farther to be
            hidden, metres.
    """

    nearest: Array
    farthest: Array
    margin: float

    @classmethod
    def of(
        cls, points: NDArray[np.floating], bin_size: float = _BIN, margin: float = _MARGIN
    ) -> RangeImage:
        """The range image of a fragment's points (n, 3) in its sensor frame; `bin_size` in deg."""
        rows = round(180 / bin_size)
        cells, distances = _directions(np.asarray(points, dtype=np.float64), rows)
        nearest = np.full((rows, 2 * rows), np.inf)
        farthest = np.full((rows, 2 * rows), -np.inf)
        np.minimum.at(nearest, cells, distances)
        np.maximum.at(farthest, cells, distances)
        mode = ("nearest", "wrap")
        return cls(
            minimum_filter(nearest, 3, mode=mode), maximum_filter(farthest, 3, mode=mode), margin
        )

    def empty(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of points (..., 3) was seen to be empty, (...)."""
        return self._emptiness(*_directions(points, len(self.nearest)))

    def look(self, points: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which of points (..., 3) lie in free space, and which on a surface, each (...)."""
        cells, distances = _directions(points, len(self.nearest))
        free = self._emptiness(cells, distances)
        behind = distances > self.farthest[cells] + self.margin
        return free, ~free & ~behind

    def compare(self, points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """How many of points (..., n, 3) lie in free space, and how many on a surface, (...)."""
        free, shared = self.look(points)
        return np.count_nonzero(free, axis=-1), np.count_nonzero(shared, axis=-1)

    def _emptiness(self, cells: _Cells, distances: Array) -> NDArray[np.bool_]:
        nearest = self.nearest[cells]
        return np.asarray(np.isfinite(nearest) & (distances < nearest - self.margin))


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


def _directions(points: Array, rows: int) -> tuple[_Cells, Array]:
    """Row and column of a range image of so many rows, and distance, of points (..., 3)."""
    distances, azimuth, elevation = spherical(points)
    bin_size = np.pi / rows
    row = np.minimum((elevation / bin_size).astype(np.intp), rows - 1)
    column = np.minimum((azimuth / bin_size).astype(np.intp), 2 * rows - 1)
    return (row, column), distances
