"""How GeoTransformer learns: which patches overlap, and which of their points match.

Qin et al., CVPR 2022, section 3.5; radii are those of its authors on 3DMatch, in voxels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Points
from nss_ros.geometry import transform_points
from nss_ros.registration.learned.geometric_embedding import NEIGHBOURS
from nss_ros.registration.learned.geotransformer import LIMITS
from nss_ros.registration.learned.geotransformer_backbone import RADIUS
from nss_ros.registration.learned.geotransformer_network import Cloud, GeoTransformerNetwork
from nss_ros.registration.learned.pyramid import Level, grid_subsampled, pyramid
from nss_ros.registration.learned.superpoints import patches
from nss_ros.registration.learned.training.circle_loss import circle_loss
from nss_ros.registration.learned.training.example import Example, correspondences

# Voxels between points of the second level that match in truth.
_MATCHED = 2.0
# Patches that overlap by more are positives, and have points to match.
_LEAST_OVERLAP = 0.1
_SCALE = 24
_PATCHES = 128


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """What the losses of a pair are calculated from.

    Attributes:
        levels: pyramid of target and source.
        overlap: (n, m) float32, of the patches of target and source.
        rows: (b,) int64, patches of the target whose points are matched with those of
        columns: (b,) int64, patches of the source.
        moved: (k, 3) float32, true places of the source's points of the second level, in the
            target's frame, metres.
    """

    levels: list[Level]
    overlap: Tensor
    rows: Tensor
    columns: Tensor
    moved: Tensor


class GeoTransformerTrainee:
    """GeoTransformer, from untrained weights."""

    learning_rate = 1e-4

    def __init__(self, config: RegistrationConfig, device: torch.device) -> None:
        self._voxel_size = config.geotransformer.voxel_size
        self._device = device
        self.network = GeoTransformerNetwork(self._voxel_size).to(device)

    def prepare(self, example: Example, random: np.random.Generator) -> PreparedPair | None:
        """The pyramid of both clouds, and what overlaps."""
        size = self._voxel_size
        clouds = [grid_subsampled(each, size) for each in (example.target, example.source)]
        levels = pyramid(clouds, size, RADIUS * size, LIMITS, self._device)
        if min(levels[-1].lengths) <= NEIGHBOURS:
            return None
        target, source = _split(levels[1])
        moved = transform_points(example.T_target_source, source).astype(np.float32)
        pairs = correspondences(moved, target, np.eye(4), _MATCHED * size)
        coarse_target, coarse_source = _split(levels[3])
        overlap = patch_overlap(
            Patches.of(target, coarse_target), Patches.of(source, coarse_source), pairs[:, ::-1]
        )
        chosen = random.permutation(np.argwhere(overlap > _LEAST_OVERLAP))[:_PATCHES]
        if len(chosen) == 0:
            return None
        rows, columns, shares, places = (
            torch.from_numpy(np.ascontiguousarray(each)).to(self._device)
            for each in (chosen[:, 0], chosen[:, 1], overlap, moved)
        )
        return PreparedPair(levels, shares, rows, columns, places)

    def losses(self, prepared: PreparedPair) -> Mapping[str, Tensor]:
        """Of superpoints and of points, of equal weight."""
        overlap, rows, columns = prepared.overlap, prepared.rows, prepared.columns
        target, source = self.network.describe(prepared.levels)
        described = torch.cdist(target.descriptors, source.descriptors)
        assigned = self.network.assigned(target, source, rows, columns)
        matched = matching(
            target,
            source._replace(points=prepared.moved),
            rows,
            columns,
            _MATCHED * self._voxel_size,
        )
        positive = overlap > _LEAST_OVERLAP
        return {
            "superpoints": circle_loss(described, positive, overlap == 0, _SCALE, overlap.sqrt()),
            "points": assignment_loss(assigned, matched, target.mask[rows], source.mask[columns]),
        }


@dataclass(frozen=True, slots=True)
class Patches:
    """The points of a cloud by patches.

    Attributes:
        points: (n, k) int64, of each patch; `count` where there is none.
        count: of all points.
    """

    points: NDArray[np.int64]
    count: int

    @classmethod
    def of(cls, fine: Points, coarse: Points) -> Patches:
        """Of points (m, 3) and superpoints (n, 3)."""
        return cls(patches(fine, coarse).numpy(), len(fine))

    def sizes(self) -> NDArray[np.int64]:
        """Points of each patch, (n,), one at least."""
        return np.asarray(np.maximum((self.points < self.count).sum(axis=1), 1))

    def owners(self) -> NDArray[np.int64]:
        """The patch of each point, (count,); -1 where it is in none."""
        owners = np.full(self.count + 1, -1)
        owners[self.points] = np.arange(len(self.points))[:, None]
        return owners[:-1]


def patch_overlap(
    target: Patches, source: Patches, pairs: NDArray[np.int64]
) -> NDArray[np.float32]:
    """By how much each two patches overlap, (n, m): the mean of the shares of both.

    Args:
        target: n patches.
        source: m patches.
        pairs: (p, 2) points of target and source that lie on each other.
    """
    rows, columns = target.owners()[pairs[:, 0]], source.owners()[pairs[:, 1]]
    owned = (rows >= 0) & (columns >= 0)
    counts = np.zeros((2, len(target.points), len(source.points)), dtype=np.float32)
    for side in range(2):
        # Each point of a patch counts once for each patch of the other cloud.
        named = np.stack((rows, columns, pairs[:, side]), axis=1)[owned]
        row, column, _ = np.unique(named, axis=0).T
        np.add.at(counts[side], (row, column), 1)
    shares = counts[0] / target.sizes()[:, None] + counts[1] / source.sizes()
    return np.asarray(shares / 2, dtype=np.float32)


def matching(target: Cloud, source: Cloud, rows: Tensor, columns: Tensor, radius: float) -> Tensor:
    """Which points of pairs of patches lie on each other, (b, k, k) bool.

    Args:
        target: points, metres.
        source: points in the frame of the target, metres.
        rows: (b,) patches of the target.
        columns: (b,) patches of the source.
        radius: longest distance, metres.
    """
    row_mask, column_mask = target.mask[rows], source.mask[columns]
    one, other = (
        cloud.points[cloud.patches[which].clamp(max=len(cloud.points) - 1)]
        for cloud, which in ((target, rows), (source, columns))
    )
    near = torch.cdist(one, other, compute_mode="donot_use_mm_for_euclid_dist") <= radius
    return near & row_mask[:, :, None] & column_mask[:, None]


def assignment_loss(
    assigned: Tensor, matched: Tensor, row_mask: Tensor, column_mask: Tensor
) -> Tensor:
    """Mean negative logarithm of the true assignments (equation 11); no match is one to nothing.

    Args:
        assigned: (b, n + 1, m + 1) logarithms.
        matched: (b, n, m) bool, in truth.
        row_mask: (b, n) bool, points that exist.
        column_mask: (b, m) bool, points that exist.
    """
    wanted = torch.zeros_like(assigned, dtype=torch.bool)
    wanted[:, :-1, :-1] = matched
    wanted[:, :-1, -1] = row_mask & ~matched.any(dim=2)
    wanted[:, -1, :-1] = column_mask & ~matched.any(dim=1)
    return -assigned[wanted].mean()


def _split(level: Level) -> tuple[Points, Points]:
    """The points of target and source on a level."""
    points: Points = level.points.cpu().numpy()
    return points[: level.lengths[0]], points[level.lengths[0] :]
