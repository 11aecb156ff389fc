"""Does a method know which fragments overlap? From the overlap probabilities that it reports.

The NSS paper counts a pair as overlapping from an overlap ratio of theta = 0.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.benchmark.metrics import Floats, f1_score

MIN_OVERLAP = 0.1
"""Overlap ratio from which fragments overlap (theta)."""
MIN_PROBABILITY = 0.5
"""Probability from which a pair is called overlapping, for accuracy, precision, recall, F1."""
_CURVE_POINTS = 200

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Classification:
    """Overlap probabilities against the truth.

    Attributes:
        pairs: pairs with a probability whose truth is known.
        overlapping: of these, pairs that overlap.
        accuracy: share that is called right, 0..1.
        precision: share of those called overlapping that overlap, 0..1; NaN of none.
        recall: share of those that overlap that are called overlapping, 0..1; NaN of none.
        f1: harmonic mean of precision and recall, 0..1.
        average_precision: of the class "overlapping", 0..1: sum over thresholds of
            (recall_k - recall_(k-1)) precision_k; NaN unless there are both classes.
        mean_average_precision: mean over the two classes, "not overlapping" judged by
            1 - probability. The text of the paper's definition of its mAP was not available when
            this was written.
        auroc: area under the ROC curve, 0..1; NaN unless there are both classes.
        curve: the precision-recall curve, (threshold, precision, recall) from the lowest
            threshold, at most about 200 points.
    """

    pairs: int
    overlapping: int
    accuracy: float
    precision: float
    recall: float
    f1: float
    average_precision: float
    mean_average_precision: float
    auroc: float
    curve: tuple[tuple[float, float, float], ...]


def classify(
    overlaps: NDArray[np.bool_], probability: Floats, least: float = MIN_PROBABILITY
) -> Classification | None:
    """Score overlap probabilities, or other scores in 0..1; None of none.

    Args:
        overlaps: (n,) the truth.
        probability: (n,); NaN, meaning that the method gave none, is left out.
        least: pairs are called overlapping from here.
    """
    from sklearn.metrics import average_precision_score, roc_auc_score  # costs seconds

    known = np.isfinite(probability)
    if not known.any():
        return None
    overlaps, probability = overlaps[known], probability[known]
    called = probability >= least
    hits = np.count_nonzero(overlaps & called)
    both = bool(overlaps.any() and not overlaps.all())
    positive = float(average_precision_score(overlaps, probability)) if both else NAN
    negative = float(average_precision_score(~overlaps, 1 - probability)) if both else NAN
    return Classification(
        pairs=len(overlaps),
        overlapping=int(overlaps.sum()),
        accuracy=float((overlaps == called).mean()),
        precision=hits / int(called.sum()) if called.any() else NAN,
        recall=hits / int(overlaps.sum()) if overlaps.any() else NAN,
        f1=f1_score(overlaps, called) / 100,
        average_precision=positive,
        mean_average_precision=(positive + negative) / 2,
        auroc=float(roc_auc_score(overlaps, probability)) if both else NAN,
        curve=_curve(overlaps, probability) if both else (),
    )


Counts = tuple[Floats, Floats]
"""Weight of true and of false positives, each (k, thresholds + 1), from nothing called positive
to everything."""


Ranking = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Order of samples from the highest score, (n,), and where in it each score occurs last."""


def ranking(score: Floats) -> Ranking:
    """The ranking of samples by score, (n,) finite."""
    order = np.argsort(-score, kind="stable")
    return order, np.append(np.flatnonzero(np.diff(score[order])), len(score) - 1)


def threshold_counts(positive: NDArray[np.bool_], ranked: Ranking, weights: Floats) -> Counts:
    """True and false positives of weighted samples at every threshold, highest first.

    With `auroc` and `average_precision` this does for a thousand resamplings at once what
    scikit-learn's functions do for one sample.

    Args:
        positive: (n,) the truth.
        ranked: the samples by score.
        weights: (k, n), one sample a row.
    """
    order, last = ranked
    drawn = weights[:, order]
    everything = np.cumsum(drawn, axis=1)[:, last]
    drawn *= positive[order]
    hits = np.cumsum(drawn, axis=1)[:, last]
    nothing = np.zeros((len(weights), 1))
    return np.hstack((nothing, hits)), np.hstack((nothing, everything - hits))


def swapped(counts: Counts) -> Counts:
    """The counts with positive and negative, and the order of the scores, the other way round."""
    hits, alarms = counts
    return alarms[:, -1:] - alarms[:, ::-1], hits[:, -1:] - hits[:, ::-1]


def auroc(counts: Counts) -> Floats:
    """Area under the ROC curve, (k,); NaN without weight on both classes.

    The trapezoidal rule over all thresholds, so ties count one half.
    """
    hits, alarms = counts
    area = (np.diff(alarms, axis=1) * (hits[:, 1:] + hits[:, :-1])).sum(axis=1) / 2
    return _ratio(area, hits[:, -1] * alarms[:, -1])


def average_precision(counts: Counts) -> Floats:
    """Average precision, (k,); NaN without weight on both classes.

    The sum over thresholds of (recall_k - recall_(k-1)) precision_k.
    """
    hits, alarms = counts
    called = hits[:, 1:] + alarms[:, 1:]
    precision = np.divide(hits[:, 1:], called, out=np.zeros_like(called), where=called > 0)
    area = (np.diff(hits, axis=1) * precision).sum(axis=1)
    return _ratio(area, np.where(alarms[:, -1] > 0, hits[:, -1], 0))


def _ratio(numerator: Floats, denominator: Floats) -> Floats:
    return np.asarray(
        np.divide(numerator, denominator, out=np.full(len(numerator), NAN), where=denominator > 0)
    )


def _curve(
    overlaps: NDArray[np.bool_], probability: Floats
) -> tuple[tuple[float, float, float], ...]:
    from sklearn.metrics import precision_recall_curve  # costs seconds

    precision, recall, thresholds = precision_recall_curve(overlaps, probability)
    chosen = np.unique(
        np.linspace(0, len(thresholds) - 1, min(len(thresholds), _CURVE_POINTS)).astype(np.intp)
    )
    points = np.column_stack((thresholds, precision[:-1], recall[:-1]))[chosen]
    return tuple((float(t), float(p), float(r)) for t, p, r in points)
