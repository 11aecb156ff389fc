"""The scan of a stage as one cloud with normals, map frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.dataset.folder import DatasetFolder, FragmentColumns
from nss_ros.fragment import FragmentId, voxelize
from nss_ros.geometry import Transform
from nss_ros.icp import Surface, moved_by

# Neighbours of a point that its normal is fitted to: a disc of about 0.2 m at 0.1 m voxels.
_NEIGHBOURS = 12
_BLOCK = 100_000
# A mean of unit normals shorter than this is of normals that cancel: it says nothing.
_LEAST_AGREEMENT = 0.1


@dataclass(frozen=True, slots=True)
class StageScan:
    """All points of one stage.

    Attributes:
        points: (n, 3) float64, metres, map frame.
        normals: (n, 3) float64, unit.
        oriented: normals point to the side from which the surface was seen.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    oriented: bool = True

    def near(self, axes: NDArray[np.floating], radius: float) -> StageScan:
        """The part within upright cylinders.

        Args:
            axes: (k, 2) x and y of the cylinders, metres, map frame.
            radius: of the cylinders, metres.
        """
        planar = self.points[:, None, :2] - np.asarray(axes)[None]
        inside = (np.einsum("nki,nki->nk", planar, planar) <= radius**2).any(axis=1)
        return StageScan(self.points[inside], self.normals[inside], self.oriented)

    def sample(self, count: int, rng: np.random.Generator) -> StageScan:
        """At most `count` of the points, drawn at random, in their order."""
        if len(self.points) <= count:
            return self
        chosen = np.sort(rng.choice(len(self.points), count, replace=False))
        return StageScan(self.points[chosen], self.normals[chosen], self.oriented)

    def surface(self, origin: NDArray[np.floating]) -> Surface:
        """What ICP takes, in coordinates from `origin` (3,)."""
        return Surface.of(self.points - origin, self.normals, self.oriented)


def merge_fragments(
    fragments: Iterable[tuple[FragmentColumns, Transform]], voxel_size: float
) -> StageScan:
    """The scan of a stage from its fragments and their poses `T_map_fragment`.

    Points are averaged per voxel and direction in which the surface looks, so that both sides of
    a thin wall stay apart.

    Args:
        fragments: points with normals, and their pose.
        voxel_size: edge of the voxels, metres.
    """
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for columns, pose in fragments:
        points.append(moved_by(pose, columns.points.astype(np.float64)))
        normals.append(np.einsum("nj,ij->ni", columns.normals.astype(np.float64), pose[:3, :3]))
    return _averaged(np.concatenate(points), np.concatenate(normals), voxel_size)


def dataset_scan(
    dataset: DatasetFolder,
    area: str,
    stage: int,
    voxel_size: float,
    poses: Mapping[FragmentId, Transform] | None = None,
) -> StageScan:
    """The scan of one stage of a dataset.

    Args:
        dataset: the dataset.
        area: of the dataset.
        stage: of the area.
        voxel_size: edge of the voxels, metres.
        poses: `T_map_fragment`; None: the dataset's.

    Raises:
        FormatError: a fragment is missing or damaged.
    """
    known = dataset.poses() if poses is None else poses
    members = [each for each in dataset.fragment_ids(area) if each.stage == stage]
    return merge_fragments(((dataset.columns(m), known[m]) for m in members), voxel_size)


def scan_of_points(points: NDArray[np.floating], voxel_size: float) -> StageScan:
    """The scan of a stage from bare points (n, 3), map frame; normals are fitted, sign unknown."""
    voxels = voxelize(points, voxel_size).astype(np.float64)
    return StageScan(voxels, fitted_normals(voxels), oriented=False)


def fitted_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normals (n, 3) of planes fitted to the neighbours of points (n, 3); any sign."""
    if len(points) < 3:
        return np.tile((0.0, 0.0, 1.0), (len(points), 1))
    tree = cKDTree(points)
    blocks = []
    for start in range(0, len(points), _BLOCK):
        _, near = tree.query(points[start : start + _BLOCK], k=min(_NEIGHBOURS, len(points)))
        centred = points[near] - points[near].mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
        blocks.append(axes[:, :, 0])
    return np.concatenate(blocks)


def _averaged(
    points: NDArray[np.float64], normals: NDArray[np.float64], voxel_size: float
) -> StageScan:
    if len(points) == 0:
        return StageScan(points, normals)
    axis = np.abs(normals).argmax(axis=1)
    side = normals[np.arange(len(normals)), axis] > 0
    cells = np.floor(points / voxel_size).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = ((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]) * 6
    _, group = np.unique(keys + axis * 2 + side, return_inverse=True)
    counts = np.bincount(group)
    sums = [np.bincount(group, column) for column in np.hstack((points, normals)).T]
    means = np.column_stack(sums) / counts[:, None]
    lengths = np.linalg.norm(means[:, 3:], axis=1)
    kept = lengths > _LEAST_AGREEMENT
    return StageScan(means[kept, :3], means[kept, 3:] / lengths[kept, None])
