"""What the gravity method keeps of a levelled fragment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, Points, clean_points, voxelize
from nss_ros.registration.features import surface_normals
from nss_ros.registration.gravity.raster import Floor, Raster, find_floor, rasterize

_VOXEL_SIZE = 0.075
_FARTHEST = 12.0
# Maps of the usual size end at 4.8 m. A scanner that sees farther than this gets wide ones.
_WIDE_REACH = 5.0
#: Cells along each side of wide maps, which end at 12 m.
WIDE_SIZE = 240
# What is seen beyond wide maps still tells what is empty, and turns an alignment right.
_FARTHEST_WIDE = 24.0
# The floor of a wide scan is that on which the tripod stands, not the ground outside or a storey
# below, metres from it.
_FLOOR_RADIUS = 4.8

# A point has so many others beside it, no farther than the first times what is usual, or than the
# second times its range: far from a scanner points are sparse.
_BESIDE, _LONELY, _LONELY_FAR = 3, 2.5, 0.04
# Share of the points that have others beside them in a clean scan.
_CLEAN = 0.99


@dataclass(frozen=True, slots=True)
class LevelScan:
    """A levelled fragment, ready to be mapped from above.

    Attributes:
        id: the fragment.
        points: (n, 3) float32, voxelised, metres, sensor frame.
        normals: (n, 3) float32, unit, towards the sensor.
        floor: where the floor is.
        maps: (slices, layers, h, w) float16, see `raster`; of SIZE or of WIDE_SIZE cells.
    """

    id: FragmentId
    points: Points
    normals: Points
    floor: Floor
    maps: Raster


def scan_of(fragment: Fragment, config: RegistrationConfig) -> LevelScan:
    """Points, normals, floor and maps of the usual size of a levelled fragment."""
    points = clean_points(fragment.points)
    near = (points**2).sum(axis=1) < _FARTHEST**2
    points = without_floating(voxelize(points[near], _VOXEL_SIZE))
    normals = surface_normals(points, config.fpfh.normal_radius)
    floor = find_floor(points, normals)
    return LevelScan(fragment.id, points, normals, floor, rasterize(points, normals, floor.height))


def wide_scan_of(fragment: Fragment, config: RegistrationConfig) -> LevelScan:
    """The same of a fragment that reaches far, with wide maps."""
    points = clean_points(fragment.points)
    near = (points**2).sum(axis=1) < _FARTHEST_WIDE**2
    points = without_floating(voxelize(points[near], _VOXEL_SIZE))
    normals = surface_normals(points, config.fpfh.normal_radius)
    beside = np.hypot(points[:, 0], points[:, 1]) < _FLOOR_RADIUS
    floor = find_floor(points[beside], normals[beside])
    maps = rasterize(points, normals, floor.height, WIDE_SIZE)
    return LevelScan(fragment.id, points, normals, floor, maps)


def fitting_scan_of(fragment: Fragment, config: RegistrationConfig) -> LevelScan:
    """The same with wide maps where a fragment fills them, else with those of the usual size."""
    return (wide_scan_of if is_wide_scan(fragment) else scan_of)(fragment, config)


def is_wide_scan(fragment: Fragment) -> bool:
    """Whether wide maps tell more of a fragment than those of the usual size."""
    return _reach(fragment) > _WIDE_REACH


def without_floating(points: Points) -> Points:
    """The points (n, 3), without those that float in empty air if they are many.

    Scanners see such points where a beam meets an edge, or a mirror. Of a clean scan up to half a
    percent lie alone, and are not floating.
    """
    if len(points) <= _BESIDE:
        return points
    distance = cKDTree(points).query(points, [_BESIDE + 1])[0][:, 0]
    usual = _LONELY * float(np.median(distance))
    reach = np.maximum(usual, _LONELY_FAR * np.linalg.norm(points, axis=1))
    beside = distance < reach
    return points if beside.mean() > _CLEAN else np.asarray(points[beside])


def _reach(fragment: Fragment) -> float:
    """Horizontal distance within which the scanner saw nearly everything, metres."""
    points = clean_points(fragment.points)
    if len(points) == 0:
        return 0.0
    return float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90))
