"""What the gravity method keeps of a levelled fragment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, Points, clean_points, voxelize
from nss_ros.registration.features import surface_normals
from nss_ros.registration.gravity.raster import Floor, Raster, find_floor, rasterize

_VOXEL_SIZE = 0.075
_FARTHEST = 12.0
# The maps end at 4.8 m. Two scanners that see much farther are better told apart by all they see.
_MOST_REACH = 7.0


@dataclass(frozen=True, slots=True)
class LevelScan:
    """A levelled fragment, ready to be mapped from above.

    Attributes:
        id: the fragment.
        points: (n, 3) float32, voxelised, metres, sensor frame.
        normals: (n, 3) float32, unit, towards the sensor.
        floor: where the floor is.
        maps: (slices, layers, SIZE, SIZE) float16, see `raster`.
    """

    id: FragmentId
    points: Points
    normals: Points
    floor: Floor
    maps: Raster


def wide_scan_of(fragment: Fragment, config: RegistrationConfig) -> LevelScan:
    """The same of one that reaches far, with maps that are wider."""
    import os
    points = clean_points(fragment.points)
    far = float(os.environ.get("FAR_POINTS", 16))
    near = (points**2).sum(axis=1) < far**2
    points = voxelize(points[near], _VOXEL_SIZE)
    normals = surface_normals(points, config.fpfh.normal_radius)
    beside = np.hypot(points[:, 0], points[:, 1]) < 4.8
    floor = find_floor(points[beside], normals[beside])
    size = int(os.environ.get("FAR_SIZE", 240))
    maps = rasterize(points, normals, floor.height, size)
    return LevelScan(fragment.id, points, normals, floor, maps)


def scan_of(fragment: Fragment, config: RegistrationConfig) -> LevelScan:
    """Points, normals, floor and maps of a levelled fragment."""
    points = clean_points(fragment.points)
    near = (points**2).sum(axis=1) < _FARTHEST**2
    points = voxelize(points[near], _VOXEL_SIZE)
    normals = surface_normals(points, config.fpfh.normal_radius)
    floor = find_floor(points, normals)
    return LevelScan(fragment.id, points, normals, floor, rasterize(points, normals, floor.height))


def reaches_far(fragment: Fragment) -> bool:
    """Whether most of what the scanner saw is beyond the maps."""
    points = clean_points(fragment.points)
    if len(points) == 0:
        return False
    return float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90)) > _MOST_REACH
