"""Registration by correspondences: matched keypoints, candidates, refinement, validation.

Methods differ in how they describe and match fragments, in how they find the transforms on which
the matches agree, and in how they refine the best. What an answer says of itself (inliers,
confidence, covariance) is found in one way for all, so that their answers can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentPair
from nss_ros.geometry import Transform
from nss_ros.icp import Refined, Surface, refine
from nss_ros.registration.features import FragmentSurface
from nss_ros.registration.free_space import RangeImage, View, conflicts
from nss_ros.registration.ransac import Matches, inlier_mask
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed
from nss_ros.registration.validation import Support, support, verdict

# Candidates are compared after a few iterations on few points, and the best alone is refined.
_TRIALS = 8
_TRIAL_POINTS = 1000
_TRIAL_ITERATIONS = 10
_TRIAL_LEVELS = (2.0,)
_VIEW_POINTS = 5000
_CONFLICT_WEIGHT = 40.0

Features = TypeVar("Features", bound=FragmentSurface)


class CorrespondenceMethod(Generic[Features]):
    """What all methods that match keypoints share.

    Attributes:
        name: registered name.
        config: of registration.
        inlier_distance: a match agrees with a transform when it ends closer than this, metres.
    """

    name: str

    def __init__(self, config: RegistrationConfig) -> None:
        self.config = config
        self.inlier_distance = config.fpfh.inlier_distance

    def prepare(self, fragment: Fragment) -> Features:
        """What the method keeps of a fragment."""
        raise NotImplementedError

    def register(self, source: Features, target: Features, seed: int) -> RelativeTransform:
        """`T_target_source` of two prepared fragments; the same seed gives the same bytes."""
        pair = FragmentPair(source.id, target.id)
        for features in (source, target):
            if len(features.points) < self.config.min_points:
                message = (
                    f"{features.id} has {len(features.points)} voxelised points, fewer than "
                    f"{self.config.min_points}."
                )
                return failed(pair, self.name, Reason.TOO_FEW_POINTS, message)
        matches = self._matches(source, target)
        level = source.gravity_aligned and target.gravity_aligned
        candidates = self._candidates(matches, level, seed)
        if not candidates:
            message = f"No transform fits the {len(matches)} matched keypoints."
            return failed(pair, self.name, Reason.TOO_FEW_INLIERS, message)
        return self._answer(pair, source, target, matches, candidates, level)

    def _matches(self, source: Features, target: Features) -> Matches:
        """Matched keypoints, right and wrong."""
        raise NotImplementedError

    def _candidates(self, matches: Matches, level: bool, seed: int) -> list[Transform]:
        """Transforms on which matches agree; of levelled fragments they need not tilt."""
        raise NotImplementedError

    def _refined(
        self,
        source: Features,  # noqa: ARG002 - for methods that refine with other points
        target: Features,  # noqa: ARG002
        moving: Surface,
        still: Surface,
        start: Transform,
    ) -> Refined:
        """The best candidate refined on the fragments' points."""
        icp = self.config.icp
        return refine(moving, still, start, icp.max_distance, icp.iterations)

    def _answer(
        self,
        pair: FragmentPair,
        source: Features,
        target: Features,
        matches: Matches,
        candidates: list[Transform],
        level: bool,
    ) -> RelativeTransform:
        config = self.config
        still = Surface.of(target.points, target.normals)
        views = _Views.of(source, target) if level else None
        candidates = _shortlist(matches, candidates, views, self.inlier_distance)
        trial = Surface.sample(source.points, source.normals, _TRIAL_POINTS)
        best = self._best(trial, still, matches, candidates, views)
        moving = Surface.sample(source.points, source.normals, config.icp.max_points)
        refined = self._refined(source, target, moving, still, best)
        found = support(moving, still, refined.T_target_source, config)
        reason, message = verdict(found, refined.T_target_source, level, config)
        if reason is not Reason.NONE:
            return failed(pair, self.name, reason, message)
        return RelativeTransform(
            pair,
            self.name,
            T_target_source=refined.T_target_source,
            covariance=refined.covariance,
            overlap_probability=overlap_score(found),
            confidence=self._confidence(found, matches, refined.T_target_source, views),
            inliers=found.inliers,
            inlier_ratio=found.inlier_ratio,
            rmse=found.rmse,
        )

    def _best(
        self,
        source: Surface,
        target: Surface,
        matches: Matches,
        candidates: list[Transform],
        views: _Views | None,
    ) -> Transform:
        """The most credible candidate after a short refinement."""
        if len(candidates) == 1:
            return candidates[0]
        distance = self.config.icp.max_distance
        refined = [
            refine(source, target, each, distance, _TRIAL_ITERATIONS, _TRIAL_LEVELS).T_target_source
            for each in candidates
        ]
        scores = [
            self._confidence(support(source, target, each, self.config), matches, each, views)
            for each in refined
        ]
        return refined[int(np.argmax(scores))]

    def _confidence(
        self, found: Support, matches: Matches, transform: Transform, views: _Views | None
    ) -> float:
        agreeing = inlier_mask(matches, transform, self.inlier_distance)
        conflict = float(views.conflicts(transform[None])[0]) if views else None
        return confidence_score(found, int(agreeing.sum()), self.config.overlap_distance, conflict)


def overlap_score(found: Support) -> float:
    """A monotone score in 0..1 that the fragments overlap; not calibrated.

    1 - exp(-share / 0.1) of the share of source points on the target's surface after alignment.
    """
    return float(1 - np.exp(-found.score / 0.1))


def confidence_score(
    found: Support, agreeing: int, tau: float, conflict: float | None = None
) -> float:
    """A monotone score in 0..1 that a transform is right; not calibrated.

    A logistic function of the signs that told right transforms from wrong ones best: matched
    keypoints that agree, how tightly the overlap fits, and the free space that it contradicts.
    The weights are set by hand.

    Args:
        found: support of the transform.
        agreeing: matched keypoints that agree with it.
        tau: distance of overlap, metres.
        conflict: share of surfaces in free space; None when it is not known what was seen.
    """
    score = _match_score(agreeing) + 12 * (1 - found.rmse / tau) - 13
    if conflict is not None:
        score += 4 - _CONFLICT_WEIGHT * conflict
    return float(expit(score))


def _match_score(agreeing: float) -> float:
    return float(1.5 * np.log1p(agreeing))


@dataclass(frozen=True, slots=True)
class _Views:
    """What the scanners of a levelled pair saw."""

    source: View
    target: View

    @classmethod
    def of(cls, source: FragmentSurface, target: FragmentSurface) -> _Views:
        return cls(_view(source), _view(target))

    def conflicts(self, transforms: NDArray[np.float64], thinning: int = 1) -> NDArray[np.float64]:
        source = View(self.source.points[::thinning], self.source.image)
        target = View(self.target.points[::thinning], self.target.image)
        return conflicts(source, target, transforms)


def _view(features: FragmentSurface) -> View:
    seen = Surface.sample(features.points, features.normals, _VIEW_POINTS)
    return View(seen.points, RangeImage.of(features.points))


def _shortlist(
    matches: Matches, candidates: list[Transform], views: _Views | None, distance: float
) -> list[Transform]:
    """The candidates worth refining, by matches that agree and free space that contradicts."""
    if len(candidates) <= _TRIALS:
        return candidates
    scores = np.array(
        [_match_score(inlier_mask(matches, each, distance).sum()) for each in candidates]
    )
    if views is not None:
        scores -= _CONFLICT_WEIGHT * views.conflicts(np.array(candidates), thinning=5)
    order = np.argsort(-scores, kind="stable")[:_TRIALS]
    return [candidates[i] for i in order]
