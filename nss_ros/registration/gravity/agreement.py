"""How an alignment of two levelled fragments agrees with what both scanners saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform, inverse
from nss_ros.icp import moved_by
from nss_ros.registration.free_space import RangeImage

_WALL_NORMAL = 0.5
_POINTS = 3000

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WallView:
    """What a scanner saw, and the points of it that fix x, y and yaw.

    Attributes:
        image: of all points.
        walls: (n, 3) float64, some of the points on surfaces that are not level, sensor frame.
    """

    image: RangeImage
    walls: Array

    @classmethod
    def of(cls, points: NDArray[np.floating], normals: NDArray[np.floating]) -> WallView:
        """The view of a fragment's points (n, 3) with normals (n, 3), in its sensor frame."""
        walls = points[np.abs(normals[:, 2]) < _WALL_NORMAL]
        step = max(len(walls) // _POINTS, 1)
        return cls(RangeImage.of(points), np.asarray(walls[::step], dtype=np.float64))


@dataclass(frozen=True, slots=True)
class Agreement:
    """What becomes of the wall points of both fragments in the view of the other.

    Attributes:
        free: share that lies where the other scanner saw that nothing is.
        shared: share that lies on what the other scanner saw.
    """

    free: float
    shared: float

    @property
    def conflict(self) -> float:
        """Share in 0..1 of the points that the other scanner should see, and does not."""
        return (self.free + 1e-3) / (self.free + self.shared + 1e-3)


def agreement(source: WallView, target: WallView, T_target_source: Transform) -> Agreement:
    """The agreement of an alignment."""
    forth = target.image.compare(moved_by(T_target_source, source.walls))
    back = source.image.compare(moved_by(inverse(T_target_source), target.walls))
    count = max(len(source.walls) + len(target.walls), 1)
    return Agreement(float(forth[0] + back[0]) / count, float(forth[1] + back[1]) / count)
