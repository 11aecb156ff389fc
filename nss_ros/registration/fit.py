"""How well the walls of two surfaces lie on each other, to the centimetre."""

from __future__ import annotations

import numpy as np

from nss_ros.geometry import Transform
from nss_ros.icp import Surface, facing

# How near to a wall a point must be to count a quarter, metres; how its normal may differ, cosine;
# and what a wall is.
_WIDTH, _FACING, _WALL_NORMAL = 0.03, 0.7, 0.5


def fit(source: Surface, target: Surface, T_target_source: Transform, distance: float) -> float:
    """Share of the source's points that lie on a wall of the target, facing the same way, 0..1.

    Floors and ceilings, which lie on each other wherever one stands, do not count.

    Args:
        source: that is moved.
        target: that stays.
        T_target_source: (4, 4).
        distance: from the nearest point of the target at most, metres.
    """
    _, normals, gaps = facing(source, target, T_target_source, distance, _FACING)
    walls = np.abs(normals[:, 2]) < _WALL_NORMAL
    weights = (_WIDTH**2 / (_WIDTH**2 + gaps[walls] ** 2)) ** 2
    return float(weights.sum()) / max(len(source.points), 1)
