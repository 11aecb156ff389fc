"""Which way is up in a fragment whose z axis points about up: told by floors and ceilings.

A tripod is levelled to half a degree. A robot, a trolley or a scanner put down by hand is not, and
a relative tilt of some degrees hides the right pose from a search of yaw and translation only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import Points, clean_points, voxelize
from nss_ros.geometry import Transform, Vector, from_up

_VOXEL_SIZE, _NEIGHBOURS = 0.1, 20
# Surfaces tilted by more than this, radians, are no floors; the axis is found again among those
# that are near it.
_LEVEL, _NEAR = np.radians(12.0), np.radians(4.0)
# Least points, and least share of them that lies on level surfaces.
_LEAST_POINTS, _LEAST_LEVEL = 100, 0.1
# Tilts below this, radians, are those of a levelled tripod, with which the search gets along.
_TILTED = np.radians(1.5)


class LevelSurfaces(NamedTuple):
    """Floors and ceilings of a fragment.

    Attributes:
        up: (3,) unit vector across them, upwards.
        points: (n, 3) voxelised, on them.
        share: of all voxelised points, that lies on them.
        walls: (m, 3) unit normals of what stands about upright on them.
    """

    up: Vector
    points: Points
    share: float
    walls: NDArray[np.float64]

    @property
    def tilt(self) -> float:
        """Angle between up and the z axis, radians."""
        return float(np.arccos(min(self.up[2], 1.0)))

    @property
    def walls_agree(self) -> bool:
        """Whether walls stand upright on them rather than along the z axis.

        They do if the scanner is tilted; if the ground slopes, they do not.
        """
        if len(self.walls) < _LEAST_POINTS:
            return False
        return float(np.mean((self.walls @ self.up) ** 2)) < float(np.mean(self.walls[:, 2] ** 2))


def level_surfaces(points: Points) -> LevelSurfaces | None:
    """Floors and ceilings; None where too little is level.

    Args:
        points: (n, 3), metres, z within some degrees of up.
    """
    cloud = voxelize(clean_points(points), _VOXEL_SIZE)
    if len(cloud) < _LEAST_POINTS:
        return None
    normals = _normals(cloud)
    up = np.array([0.0, 0.0, 1.0])
    for reach in (_LEVEL, _LEVEL, _NEAR):
        level = np.abs(normals @ up) > np.cos(reach)
        if level.mean() < _LEAST_LEVEL:
            return None
        up = np.linalg.eigh(normals[level].T @ normals[level])[1][:, -1]
        up *= np.copysign(1.0, up[2])
    walls = normals[np.maximum(np.abs(normals @ up), np.abs(normals[:, 2])) < np.sin(_LEVEL)]
    return LevelSurfaces(up, cloud[level], float(level.mean()), walls)


def upright_frame(points: Points) -> Transform:
    """Pose (4, 4) of an upright frame with the same origin; the identity unless this one is tilted.

    Walls must tell the same as floors and ceilings: ground may slope.

    Args:
        points: (n, 3), metres, z within some degrees of up.
    """
    surfaces = level_surfaces(points)
    if surfaces is None or surfaces.tilt < _TILTED or not surfaces.walls_agree:
        return np.eye(4)
    return from_up(surfaces.up)


def _normals(points: Points) -> NDArray[np.float64]:
    import open3d as o3d  # costs seconds

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
    return np.asarray(cloud.normals)
