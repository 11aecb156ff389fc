"""Whether a confidence can be believed: does what is given 0.8 turn out right in 80 %?

A pose graph weighs its edges by confidence, so it needs one that means what it says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.benchmark.metrics import Floats

BINS = 10
"""Bins of equal width of the reliability curve."""


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """One point of the reliability curve.

    Attributes:
        low: smallest confidence.
        high: largest confidence, exclusive but for 1.
        count: estimates in the bin.
        confidence: their mean confidence, 0..1; NaN of none.
        accuracy: share of them that is right, 0..1; NaN of none.
    """

    low: float
    high: float
    count: int
    confidence: float
    accuracy: float


@dataclass(frozen=True, slots=True)
class Calibration:
    """How confidence and success agree.

    Attributes:
        count: estimates with a finite confidence whose success is known.
        accuracy: share of them that is right, 0..1.
        confidence: their mean confidence, 0..1.
        expected_error: expected calibration error, 0..1; see `expected_calibration_error`.
        brier: mean squared difference of confidence and success (1 or 0), 0..1.
        auroc: probability that a right estimate has more confidence than a wrong one, 0..1; NaN
            unless there are right and wrong ones.
        curve: the reliability curve, `BINS` bins from 0 to 1.
    """

    count: int
    accuracy: float
    confidence: float
    expected_error: float
    brier: float
    auroc: float
    curve: tuple[ReliabilityBin, ...]


def calibrate(success: NDArray[np.bool_], confidence: Floats) -> Calibration | None:
    """The calibration of estimates; None of none.

    Args:
        success: (n,) whether each is right.
        confidence: (n,); values outside 0..1 count as 0 or 1, NaN is left out.
    """
    from sklearn.metrics import brier_score_loss, roc_auc_score  # costs seconds

    known = np.isfinite(confidence)
    if not known.any():
        return None
    success, confidence = success[known], np.clip(confidence[known], 0, 1)
    weights = np.ones((1, len(success)))
    count, total, right = (sums[0] for sums in _bin_sums(success, confidence, weights))
    bins = []
    for i in range(BINS):
        some = max(count[i], 1) if count[i] else float("nan")
        low, high = i / BINS, (i + 1) / BINS
        bins.append(
            ReliabilityBin(low, high, int(count[i]), float(total[i] / some), float(right[i] / some))
        )
    two = success.any() and not success.all()
    return Calibration(
        count=len(success),
        accuracy=float(success.mean()),
        confidence=float(confidence.mean()),
        expected_error=float(expected_calibration_error(success, confidence, weights)[0]),
        brier=float(brier_score_loss(success, confidence, pos_label=True)),
        auroc=float(roc_auc_score(success, confidence)) if two else float("nan"),
        curve=tuple(bins),
    )


def expected_calibration_error(
    success: NDArray[np.bool_], confidence: Floats, weights: Floats
) -> Floats:
    """Expected calibration error of weighted samples, 0..1, (k,); NaN of no weight.

    ECE = sum over bins b of n_b / n |accuracy_b - mean confidence_b|, with ten bins of equal
    width (Guo et al., "On calibration of modern neural networks", ICML 2017).

    Args:
        success: (n,) whether each estimate is right.
        confidence: (n,) in 0..1, finite.
        weights: (k, n), one sample a row.
    """
    _, total, right = _bin_sums(success, confidence, weights)
    weight = weights.sum(axis=1)
    gap = np.abs(right - total).sum(axis=1)
    return np.asarray(
        np.divide(gap, weight, out=np.full(len(weights), float("nan")), where=weight > 0)
    )


def _bin_sums(
    success: NDArray[np.bool_], confidence: Floats, weights: Floats
) -> tuple[Floats, Floats, Floats]:
    """Weight, weighted confidence and weighted successes of every bin, each (k, BINS)."""
    member = np.zeros((len(success), BINS))
    bins = np.minimum((confidence * BINS).astype(np.intp), BINS - 1)
    member[np.arange(len(success)), bins] = 1
    return (
        weights @ member,
        weights @ (member * confidence[:, None]),
        weights @ (member * success[:, None]),
    )
