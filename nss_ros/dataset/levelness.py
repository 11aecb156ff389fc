"""Whether a fragment looks like a scan of a levelled tripod, told by what should be level in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nss_ros.dataset.challenge_folder import read_fragment
from nss_ros.fragment import FragmentId, Points, clean_points, voxelize
from nss_ros.standpoint import standpoint

_VOXEL_SIZE, _NEIGHBOURS = 0.1, 20
# Surfaces tilted by more than this, radians, are no floors; the axis is found again among those
# that are near it.
_LEVEL, _NEAR = np.radians(12.0), np.radians(4.0)
# Least share of the points that lies on level surfaces, and on a floor below the sensor.
_LEAST_LEVEL, _LEAST_FLOOR = 0.1, 0.03
_FLOOR_BELOW = 0.5  # the sensor stands at least this high above a floor, metres
_MOST_TILT = np.radians(2.0)
_LOOKED_AT, _MOST_OF_THEM = 24, 0.8
# Axes that may be vertical instead of z, by what makes of them a frame in which z is.
_FEW = 3
_AXES = {"y": ((0, 2, 1), (1, -1, 1)), "x": ((2, 1, 0), (-1, 1, 1))}


def looks_levelled(points: Points) -> bool:
    """Whether z points up, within about two degrees, and the scanner stood above a floor.

    A levelled scan has a floor below its sensor, and level surfaces share a direction. In a frame
    turned at random hardly any surface is that close to level.

    Args:
        points: (n, 3), metres, sensor frame, or one whose origin is elsewhere.
    """
    cloud = voxelize(clean_points(points), _VOXEL_SIZE)
    if len(cloud) < 100:
        return False
    normals = _normals(cloud)
    axis = np.array([0.0, 0.0, 1.0])
    for reach in (_LEVEL, _LEVEL, _NEAR):
        level = np.abs(normals @ axis) > np.cos(reach)
        if level.mean() < _LEAST_LEVEL:
            return False
        axis = np.linalg.eigh(normals[level].T @ normals[level])[1][:, -1]
    if np.arccos(min(abs(float(axis[2])), 1.0)) >= _MOST_TILT:
        return False
    floor = level & (cloud[:, 2] < standpoint(points)[2] - _FLOOR_BELOW)
    return bool(floor.mean() > _LEAST_FLOOR)


def files_look_levelled(files: Sequence[tuple[FragmentId, Path]]) -> bool:
    """Whether nearly all of some of the fragments of PLY files look levelled.

    Raises:
        FormatError: a file is not valid, or holds no finite point.
    """
    some = files[:: max(1, -(-len(files) // _LOOKED_AT))]
    levelled = [looks_levelled(read_fragment(id_, file, True)[0].points) for id_, file in some]
    return len(levelled) > 0 and float(np.mean(levelled)) >= _MOST_OF_THEM


def other_vertical_axis(files: Sequence[tuple[FragmentId, Path]]) -> str | None:
    """The axis that is vertical where that is not z: "x" or "y"; else None.

    Whether it points up or down, nothing tells for sure: a ceiling may be taken for a floor.

    Args:
        files: PLY files of fragments that do not look levelled along z; a few are looked at.

    Raises:
        FormatError: a file is not valid, or holds no finite point.
    """
    some = files[:: max(1, -(-len(files) // _FEW))]
    clouds = [read_fragment(id_, file, True)[0].points for id_, file in some]
    for name, (columns, signs) in _AXES.items():
        turned = (cloud[:, columns] * np.array(signs, np.float32) for cloud in clouds)
        if clouds and all(map(looks_levelled, turned)):
            return name
    return None


def _normals(points: Points) -> NDArray[np.float64]:
    import open3d as o3d  # costs seconds

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
    return np.asarray(cloud.normals)
