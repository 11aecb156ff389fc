"""The figures that a run is judged by, flat and by name, each with a bootstrap interval.

`FIGURES` lists them all: pairwise figures of all, same-stage and different-stage edges (for
example `recall_different_stage`), the same of the map's poses (`multiway_recall_all`: edges within
any component of the map; `multiway_recall_main`: within the main one), and those of the map, of
overlap classification and of confidence.

Figures of edges are resampled by edge, of the map by fragment, of probabilities by answered pair;
see `bootstrap`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nss_ros.benchmark.bootstrap import Bootstrap, interval, resamplings
from nss_ros.benchmark.calibration import expected_calibration_error
from nss_ros.benchmark.classification import (
    auroc,
    average_precision,
    ranking,
    swapped,
    threshold_counts,
)
from nss_ros.benchmark.evaluation import (
    Answers,
    Edges,
    Estimates,
    Evaluation,
    Numbers,
    Placements,
    in_main_successes,
)
from nss_ros.benchmark.metrics import MAX_RTE_CHALLENGE, Floats, successes
from nss_ros.fragment import FragmentId

KINDS = ("all", "same_stage", "different_stage")


@dataclass(frozen=True, slots=True)
class Figure:
    """What a headline figure is.

    Attributes:
        title: for people.
        unit: `%`, `m`, `deg`, or empty for a share or probability of 0..1.
        higher_is_better: larger values are better.
    """

    title: str
    unit: str
    higher_is_better: bool

    @property
    def is_share(self) -> bool:
        """Whether it is a part of a whole: percent, or 0..1."""
        return self.unit in ("%", "")


@dataclass(frozen=True, slots=True)
class Headline:
    """A headline figure of a run.

    Attributes:
        value: in `unit`; NaN where there is nothing to compute it from.
        low: lower end of the bootstrap interval; NaN without.
        high: upper end of the bootstrap interval; NaN without.
        unit: `%`, `m`, `deg`, or empty for 0..1.
    """

    value: float
    low: float
    high: float
    unit: str


_EDGE_FIGURES = {
    "recall": Figure("recall", "%", True),
    "recall_challenge": Figure("recall at 0.1 m", "%", True),
    "rte": Figure("RTE", "m", False),
    "rre": Figure("RRE", "deg", False),
    "rte_answered": Figure("RTE of all answered", "m", False),
    "rre_answered": Figure("RRE of all answered", "deg", False),
    "rmse": Figure("RMSE", "m", False),
}
_KIND_TITLES = {"all": "all", "same_stage": "same", "different_stage": "different"}
_MAIN_RECALL = "multiway_recall_main"
_MAP_FIGURES = {
    _MAIN_RECALL: Figure("map recall in the main component", "%", True),
    "global_rmse": Figure("global RMSE", "m", False),
    "official_global_rmse": Figure("official global RMSE", "m", False),
    "coverage": Figure("coverage of points", "%", True),
    "outlier_f1": Figure("outlier F1", "%", True),
}
_ANSWER_FIGURES = {
    "overlap_average_precision": Figure("overlap: average precision", "", True),
    "overlap_mean_average_precision": Figure("overlap: mAP", "", True),
    "overlap_auroc": Figure("overlap: AUROC", "", True),
    "map_overlap_average_precision": Figure("overlap by the map: average precision", "", True),
    "map_overlap_mean_average_precision": Figure("overlap by the map: mAP", "", True),
    "map_overlap_auroc": Figure("overlap by the map: AUROC", "", True),
    "confidence_error": Figure("confidence: ECE", "", False),
    "confidence_auroc": Figure("confidence: AUROC", "", True),
}


def _figures() -> dict[str, Figure]:
    figures = {}
    for prefix, source in (("", "pairwise"), ("multiway_", "map")):
        for name, figure in _EDGE_FIGURES.items():
            for kind in KINDS:
                title = f"{source} {figure.title}, {_KIND_TITLES[kind]}"
                figures[f"{prefix}{name}_{kind}"] = Figure(
                    title, figure.unit, figure.higher_is_better
                )
    return figures | _MAP_FIGURES | _ANSWER_FIGURES


FIGURES = _figures()
"""Every headline figure by name."""

Values = dict[str, Floats]
"""Values of figures by name, one per resampling."""


def headline(evaluation: Evaluation, bootstrap: Bootstrap | None = None) -> dict[str, Headline]:
    """All headline figures for which there are data, in the order of `FIGURES`.

    Args:
        evaluation: of a log.
        bootstrap: how to resample; None: as `Bootstrap` has it.
    """
    bootstrap = bootstrap or Bootstrap()
    result = {}
    for sample in samples([evaluation]):
        (values,) = sample.once()
        ends = {}
        if bootstrap.resamplings:
            (drawn,) = sample.resampled(bootstrap)
            ends = {n: interval(v, bootstrap.level, sample.size) for n, v in drawn.items()}
        for name, value in values.items():
            low, high = ends.get(name, (float("nan"), float("nan")))
            result[name] = Headline(float(value[0]), low, high, FIGURES[name].unit)
    return {name: result[name] for name in FIGURES if name in result}


@dataclass(frozen=True, slots=True)
class Sample:
    """Units that are resampled together, and the figures of each run that they give.

    Attributes:
        size: number of units.
        members: (size, k) numbers of the fragments of each unit.
        figures: one function per run: weights (k, size) to figures by name, (k,) each.
    """

    size: int
    members: Numbers
    figures: tuple[Callable[[Floats], Values], ...]

    def once(self) -> list[Values]:
        """The figures of the sample itself, of each run."""
        return [figures(np.ones((1, self.size))) for figures in self.figures]

    def resampled(self, bootstrap: Bootstrap) -> list[Values]:
        """The figures of every resampling, of each run: all runs see the same resamplings."""
        blocks = [
            [figures(weights) for figures in self.figures]
            for weights in resamplings(self.size, bootstrap, self.members)
        ]
        return [
            {name: np.concatenate([block[run][name] for block in blocks]) for name in values}
            for run, values in enumerate(blocks[0])
        ]


def samples(evaluations: Sequence[Evaluation]) -> list[Sample]:
    """Edges, fragments and answers of runs, row by row of the same pairs and fragments.

    Args:
        evaluations: their edges are of the same pairs in the same order; so are the fragments
            of those with a map, and the answers if there are several runs.
    """
    first = evaluations[0]
    result = [
        Sample(
            len(first.edges.pairs),
            fragment_numbers([(pair.source, pair.target) for pair in first.edges.pairs]),
            tuple(_edge_figures(each.edges) for each in evaluations),
        )
    ]
    placements = [each.placements for each in evaluations if each.placements is not None]
    if len(placements) == len(evaluations):
        ids = [(id_,) for id_ in placements[0].ids]
        figures = tuple(_map_figures(each) for each in placements)
        result.append(Sample(len(ids), fragment_numbers(ids), figures))
    pairs = [(pair.source, pair.target) for pair in first.answers.pairs]
    figures = tuple(_answer_figures(each.answers) for each in evaluations)
    result.append(Sample(len(pairs), fragment_numbers(pairs), figures))
    return [sample for sample in result if sample.size]


def fragment_numbers(units: Sequence[tuple[FragmentId, ...]]) -> Numbers:
    """The fragments of units, numbered from 0 in the order of appearance, (units, k)."""
    numbers: dict[FragmentId, int] = {}
    flat = [[numbers.setdefault(each, len(numbers)) for each in unit] for unit in units]
    return np.array(flat, dtype=np.intp) if flat else np.zeros((0, 1), dtype=np.intp)


def _edge_figures(edges: Edges) -> Callable[[Floats], Values]:
    estimates = {"": edges.pairwise}
    if edges.multiway is not None:
        estimates["multiway_"] = edges.multiway
    table = np.column_stack([_edge_columns(each) for each in estimates.values()])
    main = in_main_successes(edges)
    kinds = (np.flatnonzero(edges.same_stage), np.flatnonzero(~edges.same_stage))

    def figures(weights: Floats) -> Values:
        same, different = (weights[:, kind] @ table[kind] for kind in kinds)
        values: Values = {}
        for kind, sums in zip(KINDS, (same + different, same, different), strict=True):
            for prefix, part in zip(estimates, np.split(sums, len(estimates), axis=1), strict=True):
                for name, value in _edge_values(part).items():
                    values[f"{prefix}{name}_{kind}"] = value
        if edges.multiway is not None:
            values[_MAIN_RECALL] = _ratio(100 * (weights @ main), weights.sum(axis=1))
        return values

    return figures


def _edge_columns(estimates: Estimates) -> Floats:
    """What is summed over edges, (n, 10); `_edge_values` reads it."""
    rre, rte, rmse = estimates.rre, estimates.rte, estimates.rmse
    success, answered, measured = successes(rre, rte), estimates.answered, np.isfinite(rmse)
    return np.column_stack(
        (
            np.ones(len(rre)),
            success,
            successes(rre, rte, max_rte=MAX_RTE_CHALLENGE),
            np.where(success, rte, 0),
            np.where(success, rre, 0),
            answered,
            np.where(answered, rte, 0),
            np.where(answered, rre, 0),
            measured,
            np.where(measured, rmse, 0),
        )
    )


def _edge_values(sums: Floats) -> Values:
    edges, success, strict, rte, rre, answered, rte_all, rre_all, measured, rmse = sums.T
    return {
        "recall": _ratio(100 * success, edges),
        "recall_challenge": _ratio(100 * strict, edges),
        "rte": _ratio(rte, success),
        "rre": _ratio(rre, success),
        "rte_answered": _ratio(rte_all, answered),
        "rre_answered": _ratio(rre_all, answered),
        "rmse": _ratio(rmse, measured),
    }


def _map_figures(placements: Placements) -> Callable[[Floats], Values]:
    unplaced = ~placements.placed
    graphs = [np.flatnonzero(placements.graph == g) for g in np.unique(placements.graph)]
    # Only points of placed fragments can be displaced, in graphs that hold a true pose.
    placed_points = np.where(placements.placed, placements.points, 0)
    sums = np.column_stack(
        (
            placements.squares,
            placed_points,
            placements.points,
            placements.outlier & unplaced,
            placements.outlier.astype(float) + unplaced,
        )
    )

    def figures(weights: Floats) -> Values:
        squares, here, points, hits, called = (weights @ sums).T
        official = [
            _ratio(weights[:, g] @ placements.official_squares[g],
                   weights[:, g] @ placements.points[g])
            for g in graphs
        ]  # fmt: skip
        f1 = _ratio(200 * hits, called)
        return {
            "global_rmse": np.sqrt(_ratio(squares, here)),
            "official_global_rmse": np.sqrt(np.stack(official)).mean(axis=0),
            "coverage": _ratio(100 * here, points),
            "outlier_f1": f1 if placements.outlier.any() else np.full(len(weights), 100.0),
        }

    return figures


def _answer_figures(answers: Answers) -> Callable[[Floats], Values]:
    by_pair = _overlap_figures(answers, answers.overlap_probability)
    by_map = _overlap_figures(answers, answers.map_overlap)
    known = np.flatnonzero(np.isfinite(answers.confidence) & np.isfinite(answers.rte))
    right = successes(answers.rre[known], answers.rte[known])
    confidence = np.clip(answers.confidence[known], 0, 1)
    by_confidence = ranking(confidence)

    def figures(weights: Floats) -> Values:
        values = {f"overlap_{name}": value for name, value in by_pair(weights).items()}
        values |= {f"map_overlap_{name}": value for name, value in by_map(weights).items()}
        if len(known):
            chosen = weights[:, known]
            values["confidence_error"] = expected_calibration_error(right, confidence, chosen)
            values["confidence_auroc"] = auroc(threshold_counts(right, by_confidence, chosen))
        return values

    return figures


def _overlap_figures(answers: Answers, scores: Floats) -> Callable[[Floats], Values]:
    """Average precision, mAP and AUROC of scores (n,) that tell overlap; none of none."""
    judged = np.flatnonzero(np.isfinite(answers.overlap) & np.isfinite(scores))
    overlaps, ranked = answers.overlap[judged] == 1, ranking(scores[judged])

    def figures(weights: Floats) -> Values:
        if not len(judged):
            return {}
        counts = threshold_counts(overlaps, ranked, weights[:, judged])
        positive = average_precision(counts)
        return {
            "average_precision": positive,
            "mean_average_precision": (positive + average_precision(swapped(counts))) / 2,
            "auroc": auroc(counts),
        }

    return figures


def _ratio(numerator: Floats, denominator: Floats) -> Floats:
    """Quotients; NaN by nothing."""
    nothing = np.full(np.shape(numerator), float("nan"))
    return np.asarray(np.divide(numerator, denominator, out=nothing, where=denominator > 0))
