"""How much higher one levelled fragment stands than another, once yaw and place are known.

Heights are told by level surfaces. Floors stay, but for screed and raised floors; ceilings come
down when they are closed, all of them by about the same, and would outvote the floors: a scanner
sees more of a ceiling than of the floor below it. So what counts is the share of the floor, of the
ceiling and of all else that agrees, not the number of points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.geometry import Transform

_LEVEL_NORMAL = 0.8
_MATCHED_POINTS = 400
# Level surfaces are matched across, with heights counting less.
_WEIGHT, _MATCH = 0.2, 0.25
_REACH, _BIN = 0.4, 0.04
_FEWEST_MATCHES = 10
# What is this near, metres, to the height of the floor or of the ceiling belongs to it.
_FLOOR_DEPTH, _CEILING_DEPTH = 0.12, 0.2
# What agreement of the whole floor, the whole ceiling and all else counts; of a few points, less.
_FLOOR_COUNTS, _CEILING_COUNTS, _REST_COUNTS, _FEW = 2.0, 1.0, 2.0, 20

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Levels:
    """Level surfaces of a fragment.

    Attributes:
        points: (n, 4) float64, x, y, weighted z, and whether it faces up.
        floor: height of the floor in the sensor frame, metres.
        ceiling: of the highest large surface that faces down; NaN where there is none.
        tree: search tree of `points`.
    """

    points: Array
    floor: float
    ceiling: float
    tree: Any

    @classmethod
    def of(
        cls, points: NDArray[np.floating], normals: NDArray[np.floating], floor: float
    ) -> Levels:
        """Level surfaces of points (n, 3) with normals (n, 3), sensor frame.

        Args:
            points: metres.
            normals: unit, towards the sensor.
            floor: height of the floor, metres.
        """
        level = np.abs(normals[:, 2]) > _LEVEL_NORMAL
        up = normals[level, 2] > 0
        columns = (points[level, :2], _WEIGHT * points[level, 2:], 10.0 * up[:, None])
        levels = np.hstack(columns).astype(np.float64)
        ceiling = _ceiling(np.asarray(points[level, 2][~up], dtype=np.float64))
        return cls(levels, floor, ceiling, cKDTree(levels))

    def groups(self, points: Array) -> tuple[NDArray[np.bool_], ...]:
        """Which of points (m, 4) lie on the floor, on the ceiling, and on neither, (m,) each."""
        z, up = points[:, 2] / _WEIGHT, points[:, 3] > 0
        floor = up & (np.abs(z - self.floor) < _FLOOR_DEPTH)
        ceiling = ~up & (np.abs(z - self.ceiling) < _CEILING_DEPTH)
        return floor, ceiling, ~(floor | ceiling)


def height_between(source: Levels, target: Levels, T_target_source: Transform) -> float:
    """Z of `T_target_source`, metres: of the floors, or better what most level surfaces agree on.

    Args:
        source: of the pair.
        target: of the pair.
        T_target_source: of which yaw, x and y count.
    """
    floors = target.floor - source.floor
    if len(source.points) == 0 or len(target.points) == 0:
        return floors
    moving = source.points[:: max(len(source.points) // _MATCHED_POINTS, 1)]
    distances, nearest = target.tree.query(
        _moved(moving, T_target_source, floors), distance_upper_bound=_MATCH
    )
    found = np.isfinite(distances)
    if found.sum() < _FEWEST_MATCHES:
        return floors
    moving = moving[found]
    differences = (target.points[nearest[found], 2] - moving[:, 2]) / _WEIGHT - floors
    edges = np.arange(-_REACH, _REACH + _BIN, _BIN)
    score = np.zeros(len(edges) - 1)
    weights = (_FLOOR_COUNTS, _CEILING_COUNTS, _REST_COUNTS)
    for group, weight in zip(source.groups(moving), weights, strict=True):
        counts, _ = np.histogram(differences[group], edges)
        smooth = np.convolve(counts, (0.25, 0.5, 0.25), mode="same")
        score += weight * smooth / max(int(group.sum()), _FEW)
    centre = edges[int(np.argmax(score))] + _BIN / 2
    near = np.abs(differences - centre) < _BIN
    return floors + float(np.median(differences[near])) if near.any() else floors


def _moved(points: Array, T_target_source: Transform, height: float) -> Array:
    c, s = T_target_source[0, 0], T_target_source[1, 0]
    x, y = points[:, 0], points[:, 1]
    return np.column_stack(
        (
            c * x - s * y + T_target_source[0, 3],
            s * x + c * y + T_target_source[1, 3],
            points[:, 2] + _WEIGHT * height,
            points[:, 3],
        )
    )


def _ceiling(heights: Array) -> float:
    """The highest height at which much of what faces down lies; NaN for hardly anything."""
    if len(heights) < 30:
        return float("nan")
    edges = np.arange(heights.min() - 0.05, heights.max() + 0.1, 0.05)
    counts, _ = np.histogram(heights, edges)
    smooth = np.convolve(counts, (1, 1, 1), mode="same")
    highest = np.flatnonzero(smooth >= 0.4 * smooth.max())[-1]
    return float(edges[highest] + 0.025)
