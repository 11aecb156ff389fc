"""The answer to a fragment pair."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from nss_ros.fragment import FragmentPair
from nss_ros.geometry import Matrix, Transform
from nss_ros.standpoint import Standpoints


class Reason(IntEnum):
    """Why a pair has no estimate; the values of nss_msgs/RelativeTransform REASON_*."""

    NONE = 0
    UNKNOWN_FRAGMENT = 1
    TOO_FEW_POINTS = 2
    TOO_FEW_INLIERS = 3
    NOT_LEVEL = 4
    METHOD_ERROR = 5
    WORKER_DIED = 6


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One candidate `T_target_source` of an ambiguous pair, with its probability."""

    T_target_source: Transform
    probability: float
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True, slots=True)
class RelativeTransform:
    """Estimate of `T_target_source`, or a failure with its reason.

    Attributes:
        pair: what was asked.
        method: registered name of the method.
        T_target_source: (4, 4); the identity, meaning nothing, when `reason` is not NONE.
        covariance: (6, 6) of `T_target_source`, order x y z rx ry rz (m, rad), target frame.
        reason: NONE for an estimate, else why there is none.
        message: for people, what went wrong.
        overlap_probability: probability that the fragments overlap; NaN when not estimated.
        confidence: score in 0..1 that the transform is right.
        inliers: source points with a target point within the inlier distance.
        inlier_ratio: inliers divided by the source points used.
        rmse: root mean square distance of the inliers, metres.
        compute_time: wall-clock seconds.
        alternatives: further hypotheses, most probable first.
    """

    pair: FragmentPair
    method: str
    T_target_source: Transform = field(default_factory=lambda: np.eye(4))
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    reason: Reason = Reason.NONE
    message: str = ""
    overlap_probability: float = float("nan")
    confidence: float = 0.0
    inliers: int = 0
    inlier_ratio: float = 0.0
    rmse: float = 0.0
    compute_time: float = 0.0
    alternatives: tuple[Hypothesis, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there is an estimate."""
        return self.reason is Reason.NONE


def from_standpoints(answer: RelativeTransform, standpoints: Standpoints) -> RelativeTransform:
    """An answer to fragments as seen from their standpoints, for the frames that they came in."""
    if not answer.ok or standpoints.are_origins:
        return answer
    return replace(
        answer,
        T_target_source=standpoints.transform(answer.T_target_source),
        covariance=standpoints.covariance(answer.covariance),
        alternatives=tuple(
            Hypothesis(
                standpoints.transform(each.T_target_source),
                each.probability,
                standpoints.covariance(each.covariance),
            )
            for each in answer.alternatives
        ),
    )


def failed(pair: FragmentPair, method: str, reason: Reason, message: str) -> RelativeTransform:
    """A failure to register a pair."""
    return RelativeTransform(pair, method, reason=reason, message=message)


def worker_died(pair: FragmentPair, method: str) -> RelativeTransform:
    """A failure of a pair that killed its process twice."""
    message = "The worker process that registered this pair died twice."
    return failed(pair, method, Reason.WORKER_DIED, message)
