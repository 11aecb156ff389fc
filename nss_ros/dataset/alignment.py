"""Aligning a user's own stage scans by picked points and ICP.

The paper's authors aligned the stages by hand. Here a person picks three or more points that
stand still, such as corners of columns, in each stage and in one anchor stage (for example with
CloudCompare's point picking). The best rigid transform of the picks (Umeyama 1991, without
scale) starts a point-to-plane ICP towards the anchor stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import AlignmentConfig
from nss_ros.dataset.point_pairs import PointPairs, StagePicks, read_point_pairs
from nss_ros.dataset.stage_scan import StageScan, scan_of_points
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, as_transform, transform_points
from nss_ros.icp import refine

# Picks in other units than metres differ by a factor of 10 or more; bad picks by far less.
_SCALE_LIMIT = 1.2
# First levels of ICP, as multiples of the last one's distance: picks are good to a decimetre.
_LEVELS = (4.0, 2.0, 1.0)


@dataclass(frozen=True, slots=True)
class StageAlignment:
    """One stage aligned to the anchor stage.

    Attributes:
        T_anchor_stage: (4, 4).
        residuals: (n,) distances of the picked points from their anchors by the picks alone,
            metres, in the order of the file.
        correction: largest distance by which ICP moved a picked point, metres.
        rmse: point-to-plane distance of ICP's correspondences, metres; NaN without ICP.
        correspondences: of ICP; 0 without.
        warnings: sentences for the user.
    """

    T_anchor_stage: Transform
    residuals: NDArray[np.float64]
    correction: float
    rmse: float
    correspondences: int
    warnings: tuple[str, ...]


def align_stages(
    points_file: Path,
    stage_points: Mapping[int, NDArray[np.floating] | StageScan],
    config: AlignmentConfig,
    report: Callable[[int], None] | None = None,
) -> dict[int, StageAlignment]:
    """Align every stage of a file of picked points to its anchor stage.

    Args:
        points_file: see `nss_ros.dataset.point_pairs`.
        stage_points: points (n, 3) of each stage in its own frame, metres, or its scan with
            normals; the anchor stage too.
        config: limits of the picks, and ICP.
        report: called with each stage that is done.

    Returns:
        By stage; the anchor stage is the identity.

    Raises:
        FormatError: the file is not valid.
        InputError: picks are too few, on a line, or do not fit, or a stage has no scan.
    """
    picked = read_point_pairs(points_file)
    for stage in (picked.anchor, *picked.stages):
        if stage not in stage_points:
            raise InputError(
                f"{picked.file} names stage {stage}, but there is no scan of it: give its cloud."
            )
    starts = {stage: _fit(picks, stage, picked, config) for stage, picks in picked.stages.items()}
    anchor = _scan(stage_points[picked.anchor], config)
    identity = StageAlignment(np.eye(4), np.zeros(0), 0.0, float("nan"), 0, ())
    results = {picked.anchor: identity}
    for stage, start in starts.items():
        scan = _scan(stage_points[stage], config)
        results[stage] = _refined(scan, anchor, picked.stages[stage], start, stage, config)
        if report:
            report(stage)
    return dict(sorted(results.items()))


def aligned_poses(
    poses: Mapping[FragmentId, Transform], alignments: Mapping[int, StageAlignment]
) -> dict[FragmentId, Transform]:
    """Poses in the frames of their stages as poses in the frame of the anchor stage.

    Args:
        poses: `T_stage_fragment` of one area.
        alignments: from `align_stages`.

    Raises:
        InputError: a stage has no alignment.
    """
    for fragment in poses:
        if fragment.stage not in alignments:
            raise InputError(
                f"Stage {fragment.stage} of {fragment} is not aligned: pick points of it, too."
            )
    return {
        fragment: alignments[fragment.stage].T_anchor_stage @ pose
        for fragment, pose in poses.items()
    }


def fit_rigid(points: NDArray[np.float64], anchors: NDArray[np.float64]) -> Transform:
    """`T_anchor_point` that moves points (n, 3) onto anchors (n, 3) best (Umeyama 1991)."""
    centre, anchor_centre = points.mean(axis=0), anchors.mean(axis=0)
    left, _, right = np.linalg.svd((anchors - anchor_centre).T @ (points - centre))
    mirror = np.diag((1.0, 1.0, np.sign(np.linalg.det(left @ right))))
    transform = np.eye(4)
    transform[:3, :3] = left @ mirror @ right
    transform[:3, 3] = anchor_centre - transform[:3, :3] @ centre
    return as_transform(transform)


def _scan(points: NDArray[np.floating] | StageScan, config: AlignmentConfig) -> StageScan:
    return points if isinstance(points, StageScan) else scan_of_points(points, config.voxel_size)


def _fit(picks: StagePicks, stage: int, picked: PointPairs, config: AlignmentConfig) -> Transform:
    """The transform of the picks alone, once they have been checked."""
    place = f"stage {stage} in {picked.file}"
    if len(picks.points) < 3:
        raise InputError(f"Only {len(picks.points)} points are picked of {place}: pick at least 3.")
    for points in (picks.points, picks.anchors):
        if _distance_from_line(points) < config.min_spread:
            raise InputError(
                f"The points picked of {place} lie within {config.min_spread:g} m of a line, "
                "about which the stage could turn: pick one farther from it."
            )
    scale = _size(picks.anchors) / _size(picks.points)
    if not 1 / _SCALE_LIMIT < scale < _SCALE_LIMIT:
        raise InputError(
            f"The points picked of {place} are {scale:.3g} times as far apart in the anchor "
            "stage: give all in metres."
        )
    transform = fit_rigid(picks.points, picks.anchors)
    residuals = _residuals(transform, picks)
    if residuals.max() > config.max_residual:
        worst = _worst(picks) + 1
        raise InputError(
            f"The points picked of {place} miss each other by up to {residuals.max():.2f} m; "
            f"pick {worst} fits the others worst: pick it again."
        )
    return transform


def _refined(
    scan: StageScan,
    anchor: StageScan,
    picks: StagePicks,
    start: Transform,
    stage: int,
    config: AlignmentConfig,
) -> StageAlignment:
    residuals = _residuals(start, picks)
    warnings = [
        f"Pick {number} of stage {stage} misses its anchor by {residual:.2f} m."
        for number, residual in enumerate(residuals, start=1)
        if residual > config.usual_residual
    ]
    # About the middle of the picks: far from it, a rotation is a translation.
    origin = picks.anchors.mean(axis=0)
    shift = np.eye(4)
    shift[:3, 3] = -origin
    back = np.eye(4)
    back[:3, 3] = origin
    found = refine(
        scan.sample(config.max_points, np.random.default_rng(0)).surface(np.zeros(3)),
        anchor.surface(origin),
        shift @ start,
        config.max_distance,
        config.iterations,
        _LEVELS,
        config.kernel,
    )
    transform = as_transform(back @ found.T_target_source)
    moved = transform_points(transform, picks.points) - transform_points(start, picks.points)
    correction = float(np.linalg.norm(moved, axis=1).max())
    if found.correspondences and correction <= config.max_correction:
        if not found.converged:
            warnings.append(f"ICP of stage {stage} did not settle: look at the result.")
        return StageAlignment(
            transform, residuals, correction, found.rmse, found.correspondences, tuple(warnings)
        )
    warnings.append(
        f"ICP of stage {stage} would move the picked points by {correction:.2f} m, which is not "
        "believed: its alignment is that of the picks alone."
        if found.correspondences
        else f"Stage {stage} shows nothing of the anchor stage where the picks put it: its "
        "alignment is that of the picks alone."
    )
    return StageAlignment(start, residuals, 0.0, float("nan"), 0, tuple(warnings))


def _residuals(transform: Transform, picks: StagePicks) -> NDArray[np.float64]:
    moved = transform_points(transform, picks.points)
    return np.asarray(np.linalg.norm(moved - picks.anchors, axis=1))


def _worst(picks: StagePicks) -> int:
    """The pick without which the others fit best; of three, the one with the largest residual."""
    count = len(picks.points)
    if count == 3:
        return int(_residuals(fit_rigid(picks.points, picks.anchors), picks).argmax())
    others = [np.delete(np.arange(count), each) for each in range(count)]
    misfits = []
    for rows in others:
        rest = StagePicks(picks.points[rows], picks.anchors[rows])
        misfits.append(np.square(_residuals(fit_rigid(rest.points, rest.anchors), rest)).mean())
    return int(np.argmin(misfits))


def _distance_from_line(points: NDArray[np.float64]) -> float:
    """Largest distance of a point from the line that fits them best, metres."""
    centred = points - points.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    return float(np.linalg.norm(centred - np.outer(centred @ direction, direction), axis=1).max())


def _size(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(points - points.mean(axis=0)))
