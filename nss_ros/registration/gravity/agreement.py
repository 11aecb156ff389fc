"""How an alignment of two levelled fragments agrees with what both scanners saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.geometry import Transform, inverse
from nss_ros.icp import moved_by
from nss_ros.registration.free_space import RangeImage

_WALL_NORMAL = 0.5
_POINTS = 3000
# Of a sharp view: size of a bin, degrees, and the least distance in front of a surface, metres.
_SHARP_BIN, _SHARP_MARGIN = 1.0, 0.1
# Points in free space are a thing, not an edge or a pipe that was seen through, where so many of
# them are within this distance, metres, and so large a share of all points that are.
_NEAR, _LEAST_NEAR, _LEAST_SHARE = 0.25, 3, 0.7
# A share of the points that is too small to tell anything.
_LITTLE = 0.003

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
        return cls(RangeImage.of(points), _walls(points, normals))


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


@dataclass(frozen=True, slots=True)
class SharpView:
    """The same in more detail, for poses that are aligned: where rooms are alike, things tell.

    Attributes:
        view: with smaller bins.
        near: (n,) how many wall points are near each, itself not counted.
    """

    view: WallView
    near: NDArray[np.intp]

    @classmethod
    def of(cls, points: NDArray[np.floating], normals: NDArray[np.floating]) -> SharpView:
        """The view of a fragment's points (n, 3) with normals (n, 3), in its sensor frame."""
        walls = _walls(points, normals)
        return cls(WallView(RangeImage.of(points, _SHARP_BIN, _SHARP_MARGIN), walls), _near(walls))


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Things of the one fragment where the scanner of the other saw that nothing is.

    Attributes:
        solid: share of the wall points that are of such a thing.
        free: share that is in free space.
        shared: share that lies on what the other scanner saw.
    """

    solid: float
    free: float
    shared: float

    @property
    def share(self) -> float:
        """Of what the other scanner should see, the part in 0..1 that is such things."""
        return self.solid / (self.free + self.shared + _LITTLE)

    def __add__(self, other: Contradiction) -> Contradiction:
        return Contradiction(
            self.solid + other.solid, self.free + other.free, self.shared + other.shared
        )


def contradiction(
    source: SharpView, target: SharpView, T_target_source: Transform
) -> Contradiction:
    """What of both fragments contradicts an alignment."""
    back = _things(target, source, inverse(T_target_source))
    return _things(source, target, T_target_source) + back


def _things(one: SharpView, other: SharpView, T_other_one: Transform) -> Contradiction:
    """What of one fragment the other scanner should have seen, and did not."""
    moved = moved_by(T_other_one, one.view.walls)
    free, shared = other.view.image.look(moved)
    near = _near(one.view.walls[free])
    solid = near >= np.maximum(_LEAST_SHARE * one.near[free], _LEAST_NEAR)
    count = 2 * max(len(moved), 1)
    return Contradiction(*(float(each.sum()) / count for each in (solid, free, shared)))


def _near(points: Array) -> NDArray[np.intp]:
    """How many other points are near each of points (n, 3), (n,)."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.intp)
    counts = cKDTree(points).query_ball_point(points, _NEAR, return_length=True)
    return np.asarray(counts - 1, dtype=np.intp)


def _walls(points: NDArray[np.floating], normals: NDArray[np.floating]) -> Array:
    """Some of the points on surfaces that are not level, (n, 3)."""
    walls = points[np.abs(normals[:, 2]) < _WALL_NORMAL]
    step = max(len(walls) // _POINTS, 1)
    return np.asarray(walls[::step], dtype=np.float64)
