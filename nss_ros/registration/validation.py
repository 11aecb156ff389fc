"""Whether an alignment is supported by the points, and how well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nss_ros.config import RegistrationConfig
from nss_ros.geometry import Transform, tilt_angle
from nss_ros.icp import Surface, moved_by
from nss_ros.registration.relative_transform import Reason

_NORMAL_COSINE = 0.5


@dataclass(frozen=True, slots=True)
class Support:
    """How the points support an alignment.

    Attributes:
        inliers: source points with a target point within tau.
        inlier_ratio: inliers divided by source points.
        rmse: root mean square distance of the inliers, metres.
        agreement: share of the inliers that lie on the target's surface: within the distance of
            ICP and with a like normal.
        flat: the inliers lie on a plane or a line, so that the alignment can slide.
    """

    inliers: int
    inlier_ratio: float
    rmse: float
    agreement: float
    flat: bool

    @property
    def score(self) -> float:
        """Share of the source points that lie on the target's surface."""
        return self.inlier_ratio * self.agreement


def support(
    source: Surface, target: Surface, T_target_source: Transform, config: RegistrationConfig
) -> Support:
    """The support of an alignment; tau is `overlap_distance`."""
    moved = moved_by(T_target_source, source.points)
    distances, nearest = target.tree.query(moved, distance_upper_bound=config.overlap_distance)
    found = np.flatnonzero(nearest < len(target.points))
    count = len(found)
    if count == 0:
        return Support(0, 0.0, 0.0, 0.0, True)
    distances, matched = distances[found], nearest[found]
    turned = np.einsum("nj,ij->ni", source.normals[found], T_target_source[:3, :3])
    facing = np.einsum("ij,ij->i", turned, target.normals[matched]) > _NORMAL_COSINE
    on_surface = facing & (distances < config.icp.max_distance)
    return Support(
        inliers=count,
        inlier_ratio=count / len(source.points),
        rmse=float(np.sqrt(np.mean(distances**2))),
        agreement=float(np.mean(on_surface)),
        flat=_is_flat(moved[found], config.voxel_size)
        or _is_flat(target.points[matched], config.voxel_size),
    )


def verdict(
    found: Support, T_target_source: Transform, level: bool, config: RegistrationConfig
) -> tuple[Reason, str]:
    """Why an alignment is not acceptable, with a sentence; (NONE, "") when it is.

    Args:
        found: support of the alignment.
        T_target_source: the alignment.
        level: both fragments are levelled.
        config: the limits.
    """
    tilt = np.degrees(tilt_angle(T_target_source))
    if level and tilt > config.max_tilt:
        return Reason.NOT_LEVEL, (
            f"Both fragments are levelled, but the best alignment tilts by {tilt:.1f} degrees."
        )
    if found.inlier_ratio < config.min_inlier_ratio:
        return Reason.TOO_FEW_INLIERS, (
            f"The best alignment is supported by {found.inlier_ratio:.1%} of the source points, "
            f"less than {config.min_inlier_ratio:.1%}."
        )
    if found.flat:
        return Reason.TOO_FEW_INLIERS, (
            "The overlap of the best alignment is flat or straight, so it can slide."
        )
    return Reason.NONE, ""


def _is_flat(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]], thickness: float) -> bool:
    """Whether points lie within about `thickness` of a plane."""
    centered = points - points.mean(axis=0)
    scatter = np.einsum("ni,nj->ij", centered, centered) / len(points)
    return bool(np.linalg.eigvalsh(scatter)[0] < (thickness / 2) ** 2)
