"""FPFH features of a fragment (Rusu, Blodow, Beetz: Fast point feature histograms, ICRA 2009)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, Points, clean_points, voxelize

# Histogram counts are kept in steps of 1/8 (0.1 % of a full histogram): the squared norm of three
# histograms of sum 200 then stays below 2**23, which makes matching exact; see `matching`.
_STEPS = 8
_NORMAL_NEIGHBOURS = 30
_FEATURE_NEIGHBOURS = 100
_VARIATION_NEIGHBOURS = 50


@dataclass(frozen=True, slots=True)
class FragmentSurface:
    """What alignment needs of a fragment.

    Attributes:
        id: the fragment.
        gravity_aligned: the sensor was levelled.
        points: (n, 3) float32, voxelised for refinement, metres, sensor frame.
        normals: (n, 3) float32, unit, of `points`.
    """

    id: FragmentId
    gravity_aligned: bool
    points: Points
    normals: Points


@dataclass(frozen=True, slots=True)
class FpfhFeatures(FragmentSurface):
    """What the FPFH methods keep of a fragment.

    Attributes:
        keypoints: (k, 3) float32, voxelised for description, metres, sensor frame.
        keypoint_normals: (k, 3) float32, unit.
        descriptors: (k, 33) float32, integers.
    """

    keypoints: Points
    keypoint_normals: Points
    descriptors: NDArray[np.float32]


def surface_of(fragment: Fragment, config: RegistrationConfig) -> FragmentSurface:
    """The finite points of a fragment, voxelised, with normals; it may have none."""
    points = voxelize(clean_points(fragment.points), config.voxel_size)
    viewpoint = viewpoint_of(fragment.gravity_aligned, points)
    normals = _normals(_cloud(points), viewpoint, config.fpfh.normal_radius)
    return FragmentSurface(fragment.id, fragment.gravity_aligned, points, normals)


def describe(fragment: Fragment, config: RegistrationConfig) -> FpfhFeatures:
    """The features of a fragment; too few points simply give few or no keypoints."""
    fpfh = config.fpfh
    surface = surface_of(fragment, config)
    viewpoint = viewpoint_of(fragment.gravity_aligned, surface.points)
    keypoints = voxelize(surface.points, fpfh.voxel_size)
    cloud = _cloud(keypoints)
    keypoint_normals = _normals(cloud, viewpoint, fpfh.normal_radius)
    chosen = _least_flat(cloud, fpfh.feature_radius, fpfh.max_keypoints)
    return FpfhFeatures(
        surface.id,
        surface.gravity_aligned,
        surface.points,
        surface.normals,
        keypoints[chosen],
        keypoint_normals[chosen],
        _descriptors(cloud, fpfh.feature_radius)[chosen],
    )


def surface_normals(points: Points, radius: float) -> Points:
    """Unit normals (n, 3) of points in a sensor frame, towards the sensor.

    Args:
        points: (n, 3), metres.
        radius: neighbourhood of a normal, metres.
    """
    return _normals(_cloud(points), np.zeros(3), radius)


def viewpoint_of(gravity_aligned: bool, points: Points) -> NDArray[np.float64]:
    """A point (3,) that all surfaces of a fragment with points (n, 3) face.

    A levelled fragment is a tripod scan in its sensor frame, so that is the origin. The frame of
    any other may lie anywhere (RGB-D benchmarks re-express their fragments); the centroid of a
    scanned interior mostly lies in free space, and does not depend on the frame.
    """
    if gravity_aligned or len(points) == 0:
        return np.zeros(3)
    return np.asarray(points.astype(np.float64).mean(axis=0))


def _cloud(points: Points) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))


def _normals(cloud: Any, viewpoint: NDArray[np.float64], radius: float) -> Points:
    """Unit normals (n, 3) towards the viewpoint, left in the cloud too."""
    import open3d as o3d

    if cloud.is_empty():
        return np.zeros((0, 3), dtype=np.float32)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, _NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(viewpoint)
    return np.asarray(cloud.normals).astype(np.float32)


def _descriptors(cloud: Any, radius: float) -> NDArray[np.float32]:
    import open3d as o3d

    if cloud.is_empty():
        return np.zeros((0, 33), dtype=np.float32)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius, _FEATURE_NEIGHBOURS)
    registration: Any = o3d.pipelines.registration  # its stubs make `indices` compulsory
    feature = registration.compute_fpfh_feature(cloud, search)
    histograms = np.nan_to_num(np.asarray(feature.data).T, nan=0.0, posinf=0.0, neginf=0.0)
    return np.asarray(np.round(histograms * _STEPS), dtype=np.float32)


def _least_flat(cloud: Any, radius: float, count: int) -> NDArray[np.int64]:
    """Indices of the `count` points with the largest surface variation, in ascending order.

    Surface variation (Pauly et al. 2002) is the smallest eigenvalue of the neighbours'
    covariance over their sum. Most points of a building lie on planes, where descriptors are all
    alike: they cost most of the matching and give none of the right matches.
    """
    import open3d as o3d

    size = len(cloud.points)
    if size <= count:
        return np.arange(size)
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamHybrid(radius, _VARIATION_NEIGHBOURS))
    values = np.linalg.eigvalsh(np.asarray(cloud.covariances))
    variation = values[:, 0] / np.maximum(values.sum(axis=1), 1e-12)
    return np.sort(np.argsort(-variation, kind="stable")[:count])
