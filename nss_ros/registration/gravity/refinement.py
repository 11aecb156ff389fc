"""From a pose of the search to an exact alignment, and the signs that tell whether it is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.geometry import Transform, from_yaw, inverse, relative, rotation_angle, tilt_angle
from nss_ros.icp import Refined, Surface, moved_by, refine
from nss_ros.registration.gravity.agreement import WallView, agreement
from nss_ros.registration.gravity.height import Levels, height_between
from nss_ros.registration.gravity.raster import Floor
from nss_ros.registration.gravity.scan import LevelScan
from nss_ros.registration.gravity.search import Peak, Search
from nss_ros.registration.validation import support

# Point-to-plane distance at which a surface counts a quarter, metres: what changed must not pull.
_KERNEL = 0.05
_DAMPING = 0.005
# Few points at first, all that are wanted at last.
COARSE_POINTS, _COARSE_ITERATIONS, _FINE_ITERATIONS = 1500, 10, 5
_THIN_POINTS = 800
# An alignment that leaves the cell of the search was carried away; then the pose of the search,
# which is about this good, stands.
_MOST_TRANSLATION, _MOST_ROTATION = 0.25, np.radians(5)
_PEAK_COVARIANCE = np.diag(
    [0.1**2, 0.1**2, 0.03**2, *[np.radians(0.3) ** 2] * 2, np.radians(1.5) ** 2]
)

Array = NDArray[np.float64]

#: Names of the signs, in the order of `Candidate.signs`.
SIGNS = (
    "inlier_ratio",
    "inlier_ratio_back",
    "agreement",
    "rmse",
    "free",
    "shared",
    "conflict",
    "score",
    "margin",
    "mass",
    "evidence",
    "moved",
    "turned",
    "tilt",
    "stiffness",
    "floor",
    "descriptors",
    "normals",
    "free_space",
    "margin_aligned",
    "wide",
    "comparison",
    "comparison_margin",
)


@dataclass(frozen=True, slots=True)
class Shape:
    """What alignment needs of a levelled fragment.

    Attributes:
        floor: where its floor is.
        surface: all points.
        thin: some of the points.
        coarse: some more.
        moderate: more of the points.
        levels: its level surfaces.
        view: what its scanner saw.
    """

    floor: Floor
    surface: Surface
    thin: Surface
    coarse: Surface
    moderate: Surface
    levels: Levels
    view: WallView

    @classmethod
    def of(cls, scan: LevelScan, config: RegistrationConfig) -> Shape:
        """The shape of a prepared fragment."""
        normals = scan.normals
        return cls(
            scan.floor,
            Surface.of(scan.points, normals),
            Surface.sample(scan.points, normals, _THIN_POINTS),
            Surface.sample(scan.points, normals, COARSE_POINTS),
            Surface.sample(scan.points, normals, config.icp.max_points),
            Levels.of(scan.points, normals, scan.floor.height),
            WallView.of(scan.points, normals),
        )


@dataclass(frozen=True, slots=True)
class Alignment:
    """A pose of the search, and where alignment brought it."""

    peak: Peak
    refined: Refined


@dataclass(frozen=True, slots=True)
class Candidate:
    """An aligned hypothesis.

    Attributes:
        refined: outcome of ICP.
        signs: (len(SIGNS),) float64.
    """

    refined: Refined
    signs: Array


def aligned(source: Shape, target: Shape, peak: Peak, config: RegistrationConfig) -> Alignment:
    """The exact alignment from a pose of the search.

    Only what is near in the pose of the search is matched: it is mostly nearer to the truth than
    the width of the next stud or frame, to which a wider ICP would slip.
    """
    start = from_yaw(peak.yaw, (peak.x, peak.y, 0.0))
    start[2, 3] = height_between(source.levels, target.levels, start)
    return Alignment(
        peak, refined_near(source.coarse, source.moderate, target.surface, start, config)
    )


def refined_near(
    coarse: Surface,
    moderate: Surface,
    target: Surface,
    start: Transform,
    config: RegistrationConfig,
) -> Refined:
    """The alignment near a transform; the transform itself where ICP leaves it behind.

    Args:
        coarse: few points of the source.
        moderate: more of them.
        target: all points.
        start: `T_target_source`.
        config: settings.
    """
    refined = coarsely(coarse, target, start, config)
    refined = finely(moderate, target, refined.T_target_source, config)
    if _is_near(refined.T_target_source, start):
        return refined
    there = _refined(moderate, target, start, 0, config)
    information = np.asarray(np.linalg.inv(there.covariance + _PEAK_COVARIANCE))
    return replace(there, information=information, converged=False)


def coarsely(
    coarse: Surface, target: Surface, start: Transform, config: RegistrationConfig
) -> Refined:
    """The alignment of few points that begins at a transform, wherever it ends."""
    return _refined(coarse, target, start, _COARSE_ITERATIONS, config)


def finely(
    moderate: Surface, target: Surface, start: Transform, config: RegistrationConfig
) -> Refined:
    """The same of more points, from where it ended."""
    return _refined(moderate, target, start, _FINE_ITERATIONS, config)


def _refined(
    source: Surface,
    target: Surface,
    start: Transform,
    iterations: int,
    config: RegistrationConfig,
) -> Refined:
    distance = config.icp.max_distance
    return refine(source, target, start, distance, iterations, (1.0,), _KERNEL, _DAMPING)


def judged(
    source: Shape,
    target: Shape,
    alignment: Alignment,
    parts: Sequence[float],
    second_look: tuple[float, float],
    search: Search,
    config: RegistrationConfig,
    empty_weight: float = 0.0,
) -> Candidate:
    """An alignment with its signs.

    Args:
        source: of the pair.
        target: of the pair.
        alignment: one of the pair's.
        parts: of its score, see `score_parts`.
        second_look: log-odds of it, see `compared`, and these less the largest of the pair's.
        search: that it came from.
        config: settings.
        empty_weight: what the share of points in free space takes from the score of wide maps,
            see `wide`; 0 for those of the usual size.
    """
    peak, refined = alignment.peak, alignment.refined
    transform = refined.T_target_source
    forth = support(source.moderate, target.surface, transform, config)
    seen = agreement(source.view, target.view, transform)
    descriptors, normals, free_space = parts
    parts = descriptors, normals, free_space - empty_weight * seen.free
    peak_pose = from_yaw(peak.yaw, (peak.x, peak.y, transform[2, 3]))
    difference = relative(transform, peak_pose)
    stiffness = np.linalg.eigvalsh(refined.information[np.ix_((0, 1, 5), (0, 1, 5))])[0]
    signs = (
        forth.inlier_ratio,
        _inlier_share(source, target, transform, config.overlap_distance),
        forth.agreement,
        forth.rmse,
        seen.free,
        seen.shared,
        seen.conflict,
        peak.score,
        peak.score - search.peaks[0].score,
        max(peak.mass, -20.0),
        search.evidence,
        float(np.linalg.norm(difference[:2, 3])),
        rotation_angle(difference),
        tilt_angle(transform),
        float(np.log(max(stiffness, 1e-3))),
        min(source.floor.share, target.floor.share),
        *parts,
        sum(parts) - search.peaks[0].score,
        float(empty_weight > 0),
        *second_look,
    )
    return Candidate(refined, np.array(signs))


def _is_near(transform: Transform, start: Transform) -> bool:
    difference = relative(transform, start)
    return bool(
        np.linalg.norm(difference[:3, 3]) < _MOST_TRANSLATION
        and rotation_angle(difference) < _MOST_ROTATION
    )


def _inlier_share(source: Shape, target: Shape, transform: Transform, tau: float) -> float:
    """Share of the target's points near one of the source's."""
    moved = moved_by(inverse(transform), target.thin.points)
    distances, _ = source.surface.tree.query(moved, distance_upper_bound=tau)
    return float(np.isfinite(distances).mean())
