"""Two runs compared on what both were to do: the same ground-truth edges, fragments and pairs.

An edge is compared if it is in the ground truth of both logs, with the same transform, and both
were asked for the pair; without an answer it counts as a miss, as everywhere. Resamplings are
paired: both runs see the same ones, so what makes a pair hard for both cancels out.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nss_ros.benchmark.bootstrap import Bootstrap, interval, p_value, resamplings
from nss_ros.benchmark.evaluation import (
    Booleans,
    Edges,
    Evaluation,
    Numbers,
    Placements,
    rows,
)
from nss_ros.benchmark.headline import FIGURES, KINDS, fragment_numbers, samples
from nss_ros.benchmark.metrics import (
    Floats,
    recall,
    rotation_error,
    successes,
    translation_error,
)
from nss_ros.benchmark.score import bin_numbers
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair

SAME_ROTATION = 0.01
"""Ground truths that differ by no more are the same, degrees."""
SAME_TRANSLATION = 1e-3
"""Ground truths that differ by no more are the same, metres."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A headline figure of two runs.

    Attributes:
        baseline: of the first run; NaN where there is nothing to compute it from.
        value: of the other run.
        difference: `value` less `baseline`.
        low: lower end of the difference's bootstrap interval; NaN without.
        high: upper end of the difference's bootstrap interval; NaN without.
        p_value: of "there is no difference", two-sided; NaN without.
        unit: `%` (differences in points), `m`, `deg`, or empty for 0..1.
        better: True or False if the interval is on one side of zero, None if it holds zero.
    """

    baseline: float
    value: float
    difference: float
    low: float
    high: float
    p_value: float
    unit: str
    better: bool | None


@dataclass(frozen=True, slots=True)
class BinDifference:
    """Pairwise recall of two runs in a bin, by kind of edge: all, same and different stage.

    Attributes:
        low: lower end of the bin.
        high: upper end of the bin, exclusive but for the last.
        edges: ground-truth edges.
        baseline: recall (10 deg, 0.2 m) of the first run, percent; NaN of none.
        value: recall of the other run.
        p_value: of "there is no difference".
    """

    low: float
    high: float
    edges: dict[str, int]
    baseline: dict[str, float]
    value: dict[str, float]
    p_value: dict[str, float]


@dataclass(frozen=True, slots=True)
class PairChanges:
    """Edges on which two runs differ in success (10 deg, 0.2 m).

    Attributes:
        won: the other run is right and the first wrong.
        lost: the first run is right and the other wrong.
    """

    won: tuple[FragmentPair, ...]
    lost: tuple[FragmentPair, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """A run against a baseline.

    Attributes:
        baseline: log of the first run.
        log: log of the other run.
        edges: ground-truth edges that are compared.
        fragments: fragments of the maps that are compared.
        notes: what a reader should know, for example what was left out.
        differences: by headline figure, of what is compared.
        overlap_bins: by overlap ratio.
        change_bins: by temporal change ratio.
        pairwise: relative transforms won and lost.
        multiway: relative transforms of the maps' poses won and lost; None unless both logs hold
            a map.
    """

    baseline: str
    log: str
    edges: int
    fragments: int
    notes: tuple[str, ...]
    differences: dict[str, Difference]
    overlap_bins: tuple[BinDifference, ...]
    change_bins: tuple[BinDifference, ...]
    pairwise: PairChanges
    multiway: PairChanges | None


def compare(
    baseline: Evaluation, other: Evaluation, bootstrap: Bootstrap | None = None
) -> Comparison:
    """Compare a run with a baseline.

    Args:
        baseline: the first run.
        other: the run that is judged.
        bootstrap: how to resample; None: as `Bootstrap` has it.

    Raises:
        InputError: the logs have no ground truth in common.
    """
    bootstrap = bootstrap or Bootstrap()
    first, second, notes = _common(baseline, other)
    multiway = None
    if first.edges.multiway is not None and second.edges.multiway is not None:
        multiway = _changes(
            first.edges,
            successes(first.edges.multiway.rre, first.edges.multiway.rte),
            successes(second.edges.multiway.rre, second.edges.multiway.rte),
        )
    before, after = (
        successes(each.edges.pairwise.rre, each.edges.pairwise.rte) for each in (first, second)
    )
    return Comparison(
        baseline=baseline.log,
        log=other.log,
        edges=len(first.edges.pairs),
        fragments=len(first.placements.ids) if first.placements is not None else 0,
        notes=tuple(notes),
        differences=_differences(first, second, bootstrap),
        overlap_bins=_bins(first.edges, first.edges.overlap_ratio, before, after, bootstrap),
        change_bins=_bins(first.edges, first.edges.temporal_change, before, after, bootstrap),
        pairwise=_changes(first.edges, before, after),
        multiway=multiway,
    )


def _common(baseline: Evaluation, other: Evaluation) -> tuple[Evaluation, Evaluation, list[str]]:
    """Both with the rows that they share, in the order of the first, and what was left out."""
    notes: list[str] = []
    ours, theirs = _matches(_edge_keys(baseline), _edge_keys(other))
    if not len(ours):
        raise InputError(
            f"{baseline.log} and {other.log} have no ground-truth edge in common, so they cannot "
            "be compared: give logs of the same bag or dataset."
        )
    same = _same_truth(baseline.edges.T_target_source[ours], other.edges.T_target_source[theirs])
    if not same.any():
        raise InputError(
            f"{baseline.log} and {other.log} name the same fragments, but their ground truth "
            "differs, so they cannot be compared: give logs of the same bag or dataset."
        )
    asked = _asked(baseline)[ours] & _asked(other)[theirs]
    if not (same & asked).any():
        raise InputError(
            f"{baseline.log} and {other.log} were asked for different pairs, so they cannot be "
            "compared: give logs of the same bag or dataset."
        )
    if not same.all():
        notes.append(f"{np.count_nonzero(~same)} edges with differing ground truth are left out.")
    total = max(len(baseline.edges.pairs), len(other.edges.pairs))
    if len(ours) < total:
        notes.append(f"{total - len(ours)} edges are in the ground truth of one log only.")
    if (same & ~asked).any():
        notes.append(
            f"{np.count_nonzero(same & ~asked)} edges are left out because one log was not asked "
            "for them."
        )
    for each in (baseline, other):
        if each.answered < each.pairs:
            notes.append(
                f"{each.log} is partial: {each.pairs - each.answered} of {each.pairs} pairs have "
                "no answer; they count as misses."
            )
    kept = same & asked
    first = replace(baseline, edges=rows(baseline.edges, ours[kept]))
    second = replace(other, edges=rows(other.edges, theirs[kept]))
    first, second = _common_placements(first, second)
    ours, theirs = _matches(first.answers.pairs, second.answers.pairs)
    return (
        replace(first, answers=rows(first.answers, ours)),
        replace(second, answers=rows(second.answers, theirs)),
        notes,
    )


def _common_placements(first: Evaluation, second: Evaluation) -> tuple[Evaluation, Evaluation]:
    if first.placements is None or second.placements is None:
        return replace(first, placements=None), replace(second, placements=None)
    ours, theirs = _matches(
        _placement_keys(first, first.placements), _placement_keys(second, second.placements)
    )
    truths = first.placements.T_true[ours], second.placements.T_true[theirs]
    neither = np.isnan(truths[0][:, 0, 0]) & np.isnan(truths[1][:, 0, 0])
    kept = _same_truth(*truths) | neither
    return (
        replace(first, placements=rows(first.placements, ours[kept])),
        replace(second, placements=rows(second.placements, theirs[kept])),
    )


def _edge_keys(evaluation: Evaluation) -> list[Hashable]:
    edges = evaluation.edges
    return [(evaluation.graphs[g], pair) for g, pair in zip(edges.graph, edges.pairs, strict=True)]


def _placement_keys(evaluation: Evaluation, placements: Placements) -> list[Hashable]:
    return [
        (evaluation.graphs[g], id_) for g, id_ in zip(placements.graph, placements.ids, strict=True)
    ]


def _matches(ours: Sequence[Hashable], theirs: Sequence[Hashable]) -> tuple[Numbers, Numbers]:
    """Rows of equal keys; of equal keys on one side the first counts."""
    where = {key: i for i, key in reversed(list(enumerate(theirs)))}
    found = {key: (i, where[key]) for i, key in reversed(list(enumerate(ours))) if key in where}
    table = np.array(sorted(found.values()), dtype=np.intp).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _same_truth(ours: Floats, theirs: Floats) -> Booleans:
    turned, moved = rotation_error(ours, theirs), translation_error(ours, theirs)
    return np.asarray((turned <= SAME_ROTATION) & (moved <= SAME_TRANSLATION))


def _asked(evaluation: Evaluation) -> Booleans:
    """Which edges were asked for; all if the log does not tell, since it holds only a map."""
    told = evaluation.pairs > 0 or len(evaluation.answers.pairs) > 0
    return evaluation.edges.asked if told else np.ones(len(evaluation.edges.pairs), dtype=bool)


def _differences(
    first: Evaluation, second: Evaluation, bootstrap: Bootstrap
) -> dict[str, Difference]:
    result = {}
    for sample in samples([first, second]):
        before, after = sample.once()
        drawn = sample.resampled(bootstrap) if bootstrap.resamplings else []
        for name in FIGURES:
            if name in before and name in after:
                changes = drawn[1][name] - drawn[0][name] if drawn else np.zeros(0)
                result[name] = _difference(
                    name, float(before[name][0]), float(after[name][0]), changes,
                    interval(changes, bootstrap.level, sample.size),
                )  # fmt: skip
    return {name: result[name] for name in FIGURES if name in result}


def _difference(
    name: str, before: float, after: float, changes: Floats, ends: tuple[float, float]
) -> Difference:
    figure = FIGURES[name]
    low, high = ends
    better = None
    if low > 0 or high < 0:
        better = (low > 0) == figure.higher_is_better
    return Difference(
        before, after, after - before, low, high, p_value(changes), figure.unit, better
    )


def _bins(
    edges: Edges, ratio: Floats, before: Booleans, after: Booleans, bootstrap: Bootstrap
) -> tuple[BinDifference, ...]:
    kinds = dict(
        zip(KINDS, (np.ones(len(ratio), dtype=bool), edges.same_stage, ~edges.same_stage),
            strict=True)
    )  # fmt: skip
    members = fragment_numbers([(pair.source, pair.target) for pair in edges.pairs])
    bins = []
    for (low, high), inside in bin_numbers(ratio):
        masks = {kind: mask & inside for kind, mask in kinds.items()}
        bins.append(
            BinDifference(
                low,
                high,
                {kind: int(mask.sum()) for kind, mask in masks.items()},
                {kind: recall(before[mask]) for kind, mask in masks.items()},
                {kind: recall(after[mask]) for kind, mask in masks.items()},
                {
                    kind: _recall_p_value(before[mask], after[mask], bootstrap, members[mask])
                    for kind, mask in masks.items()
                },
            )
        )
    return tuple(bins)


def _recall_p_value(
    before: Booleans, after: Booleans, bootstrap: Bootstrap, members: Numbers
) -> float:
    changes = after.astype(np.float64) - before
    if len(changes) < 2 or not bootstrap.resamplings:
        return float("nan")
    return p_value(
        np.concatenate(
            [weights @ changes for weights in resamplings(len(changes), bootstrap, members)]
        )
    )


def _changes(edges: Edges, before: Booleans, after: Booleans) -> PairChanges:
    won, lost = np.flatnonzero(after & ~before), np.flatnonzero(before & ~after)
    return PairChanges(tuple(edges.pairs[i] for i in won), tuple(edges.pairs[i] for i in lost))
