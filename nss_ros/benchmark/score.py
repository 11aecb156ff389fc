"""The score of a log: what a run estimated against the ground truth that was recorded beside it.

Pairwise figures judge the relative transforms, multi-way figures the poses of the final map.
Both are over the ground-truth edges of a graph: an edge without an answer counts as a miss, and
in the map one whose fragments are not in one component of it. A map in two halves that nothing
links can so have all edges within them right; how many fragments are in which component, and the
recall of the main component alone, stand beside it. "All", "same-stage" and "different-stage" are
by the kind of the ground-truth edge. Overall figures are micro averages: over all edges,
fragments and points of all graphs together.

A graph's main component is the largest that accepted edges form among its own fragments. Figures
that need one frame are of that alone, and the other fragments count as outliers, as in a
submission to the challenge. The global RMSE is over the points of fragments of the main component
that are no outliers in the ground truth, in the frame of the first of them, and is to be read
with its coverage; the official definition instead takes the others as collapsed into the anchor's
origin (the zero matrix of a submission), and stands beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nss_ros.bag import Log
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.calibration import Calibration, calibrate
from nss_ros.benchmark.classification import (
    MIN_OVERLAP,
    MIN_PROBABILITY,
    Classification,
    classify,
)
from nss_ros.benchmark.displacement import StageDisplacement, stage_displacements
from nss_ros.benchmark.evaluation import (
    Answers,
    Booleans,
    Edges,
    Estimates,
    Evaluation,
    Placements,
    evaluate,
    in_main_successes,
    rows,
)
from nss_ros.benchmark.headline import KINDS, Headline, headline
from nss_ros.benchmark.metrics import (
    MAX_RTE_CHALLENGE,
    Floats,
    f1_score,
    recall,
    successes,
)

NAN = float("nan")
BIN_WIDTH = 0.1
"""Of the bins of overlap ratio and temporal change ratio."""


@dataclass(frozen=True, slots=True)
class EdgeScore:
    """Errors over a set of ground-truth edges.

    Attributes:
        edges: ground-truth edges.
        answered: of these, edges with an estimate.
        recall: percent of the edges with RRE <= 10 deg and RTE <= 0.2 m.
        recall_challenge: percent of the edges with RRE <= 10 deg and RTE <= 0.1 m.
        rte: mean RTE over successes (10 deg, 0.2 m), metres; NaN without any.
        rre: mean RRE over successes (10 deg, 0.2 m), degrees; NaN without any.
        rte_answered: mean RTE over all answered edges, metres.
        rre_answered: mean RRE over all answered edges, degrees.
        rmse: mean pairwise RMSE over answered edges with correspondences, metres; NaN without.
    """

    edges: int
    answered: int
    recall: float
    recall_challenge: float
    rte: float
    rre: float
    rte_answered: float
    rre_answered: float
    rmse: float


@dataclass(frozen=True, slots=True)
class Subsets:
    """Edge scores by kind of edge."""

    all: EdgeScore
    same_stage: EdgeScore
    different_stage: EdgeScore


@dataclass(frozen=True, slots=True)
class MapScore:
    """The poses of a graph's fragments.

    Attributes:
        fragments: in the graph.
        placed: of these, fragments in the main component.
        placed_elsewhere: of these, fragments in other components.
        components: components of two or more fragments.
        component_sizes: fragments of each component, of each graph the main one first.
        recall_main: percent of all ground-truth edges that are right (10 deg, 0.2 m) in the main
            component, edges elsewhere being misses: the recall of a submission to the challenge
            at 0.2 m. Never above the multi-way recall, and equal to it with a single component.
        outlier_f1: F1 of fragments outside of the main component as outliers, percent; 100 where
            the ground truth has none, as in the challenge.
        global_rmse: over the main component, metres; NaN without point clouds or such fragments.
        coverage: percent of the ground truth's points whose fragment is in the main component;
            of fragments without point clouds.
        official_global_rmse: by the challenge's definition, on what 'nss export' would write,
            metres, overall the mean over graphs; NaN without point clouds, or where that
            definition does not apply (nothing placed).
    """

    fragments: int
    placed: int
    placed_elsewhere: int
    components: int
    component_sizes: tuple[int, ...]
    recall_main: float
    outlier_f1: float
    global_rmse: float
    coverage: float
    official_global_rmse: float


@dataclass(frozen=True, slots=True)
class GraphScore:
    """The score of one graph of the dataset, of one area, or of all together.

    Attributes:
        name: of the graph or area.
        pairwise: relative transforms against the ground truth.
        multiway: relative transforms of the map's poses within its components; None if the log
            holds no map.
        map: the map's poses; None if the log holds no map, and for an area also if one of its
            graphs reaches into another area.
    """

    name: str
    pairwise: Subsets
    multiway: Subsets | None
    map: MapScore | None


@dataclass(frozen=True, slots=True)
class BinScore:
    """Recall of the edges in a bin.

    Attributes:
        low: lower end of the bin.
        high: upper end of the bin, exclusive but for the last.
        edges: ground-truth edges by kind: all, same stage, different stage.
        pairwise: recall (10 deg, 0.2 m) of the relative transforms by kind, percent; NaN of none.
        multiway: recall of the map's poses by kind, percent; None if the log holds no map.
    """

    low: float
    high: float
    edges: dict[str, int]
    pairwise: dict[str, float]
    multiway: dict[str, float] | None


@dataclass(frozen=True, slots=True)
class OverlapScore:
    """Overlap probabilities, or ratios in the map, against the truth; None where there are none.

    Attributes:
        all: all pairs.
        same_stage: pairs of one stage.
        different_stage: pairs of different stages.
        without_probability: answers that give none, as failures may; left out.
        unknown: answers with one whose truth is not known; left out.
    """

    all: Classification | None
    same_stage: Classification | None
    different_stage: Classification | None
    without_probability: int
    unknown: int


@dataclass(frozen=True, slots=True)
class CalibrationScore:
    """Confidence against success (10 deg, 0.2 m), by kind of pair; None where there are none.

    Of every estimate whose true transform is known, also of pairs that are no ground-truth edge.
    """

    all: Calibration | None
    same_stage: Calibration | None
    different_stage: Calibration | None


@dataclass(frozen=True, slots=True)
class LogScore:
    """The score of a log.

    Attributes:
        log: path of the log.
        partial: the log is truncated or was never closed, or pairs are unanswered: later answers
            and the final map may be missing.
        truncated: the log is truncated or was never closed.
        pairs: pairs that were asked for.
        answered: of these, pairs with an answer, failures included.
        failed: of these, answers without a transform.
        has_points: point clouds were there, so RMSE is given.
        graphs: one score per graph with ground truth, in the order of the log.
        overall: micro average.
        method: registration method of most answers; empty without answers.
        synchronizer: multi-way method of the map; empty without.
        split: the dataset's split, if the log's metadata tell it.
        training: what the method was trained on, if the log's metadata tell it.
        areas: one score per area, micro averages.
        overlap_bins: recall by overlap ratio; empty bins and unknown ratios are left out.
        change_bins: recall by temporal change ratio; likewise.
        overlap: overlap classification by the methods' probabilities.
        map_overlap: the same by the overlap ratios that pairs have at the map's poses, called from
            0.1; without a map, point clouds or pairs that do not overlap there is none.
        calibration: of the confidence.
        displacements: of stages against each other; empty if the log holds no map.
        headline: headline figures by name, with bootstrap intervals; see `headline`.
        doubtful: ids of fragments of which the map says that their place is doubtful.
    """

    log: str
    partial: bool
    truncated: bool
    pairs: int
    answered: int
    failed: int
    has_points: bool
    graphs: tuple[GraphScore, ...]
    overall: GraphScore
    method: str
    synchronizer: str
    split: str
    training: str
    areas: tuple[GraphScore, ...]
    overlap_bins: tuple[BinScore, ...]
    change_bins: tuple[BinScore, ...]
    overlap: OverlapScore
    map_overlap: OverlapScore
    calibration: CalibrationScore
    displacements: tuple[StageDisplacement, ...]
    headline: dict[str, Headline]
    doubtful: tuple[str, ...]


def score_log(log: Log, bootstrap: Bootstrap | None = None) -> LogScore:
    """Score a log against its own ground truth.

    Args:
        log: with ground truth.
        bootstrap: how intervals are found; None: as `Bootstrap` has it.

    Raises:
        InputError: the log holds no ground truth, or nothing that could be scored.
    """
    return summarize(evaluate(log), bootstrap)


def summarize(evaluation: Evaluation, bootstrap: Bootstrap | None = None) -> LogScore:
    """The score of a log, or of several as one result set.

    Args:
        evaluation: what was measured.
        bootstrap: how intervals are found; None: as `Bootstrap` has it.
    """
    edges, placements = evaluation.edges, evaluation.placements
    numbers = range(len(evaluation.graphs))
    areas = sorted({str(area) for area in edges.area})
    return LogScore(
        log=evaluation.log,
        partial=evaluation.truncated or evaluation.answered < evaluation.pairs,
        truncated=evaluation.truncated,
        pairs=evaluation.pairs,
        answered=evaluation.answered,
        failed=evaluation.failed,
        has_points=evaluation.has_points,
        graphs=tuple(
            _graph_score(evaluation, evaluation.graphs[g], edges.graph == g, {g}) for g in numbers
        ),
        overall=_graph_score(
            evaluation, "overall", np.ones(len(edges.pairs), dtype=bool), set(numbers)
        ),
        method=evaluation.method,
        synchronizer=evaluation.synchronizer,
        split=evaluation.split,
        training=evaluation.training,
        areas=tuple(
            _graph_score(evaluation, area, edges.area == area, _graphs_of(area, placements))
            for area in areas
        ),
        overlap_bins=_bins(edges, edges.overlap_ratio),
        change_bins=_bins(edges, edges.temporal_change),
        overlap=_overlap_score(
            evaluation.answers, evaluation.answers.overlap_probability, MIN_PROBABILITY
        ),
        map_overlap=_overlap_score(evaluation.answers, evaluation.answers.map_overlap, MIN_OVERLAP),
        calibration=_calibration_score(evaluation.answers),
        displacements=stage_displacements(placements) if placements is not None else (),
        headline=headline(evaluation, bootstrap),
        doubtful=tuple(map(str, evaluation.doubtful)),
    )


def _graphs_of(area: str, placements: Placements | None) -> set[int]:
    """The graphs of an area; none if one reaches into another area."""
    if placements is None:
        return set()
    areas: dict[int, set[str]] = {}
    for graph, id_ in zip(placements.graph.tolist(), placements.ids, strict=True):
        areas.setdefault(graph, set()).add(id_.area)
    graphs = {graph for graph, here in areas.items() if area in here}
    return graphs if all(areas[graph] == {area} for graph in graphs) else set()


def _graph_score(
    evaluation: Evaluation, name: str, chosen: Booleans, graphs: set[int]
) -> GraphScore:
    """The score of some edges and of the fragments of some graphs."""
    edges, placements = evaluation.edges, evaluation.placements
    return GraphScore(
        name,
        _subsets(edges.pairwise, edges.same_stage, chosen),
        _subsets(edges.multiway, edges.same_stage, chosen) if edges.multiway else None,
        _map_score(evaluation, placements, chosen, graphs) if placements and graphs else None,
    )


def _subsets(estimates: Estimates, same_stage: Booleans, chosen: Booleans) -> Subsets:
    masks = (chosen, chosen & same_stage, chosen & ~same_stage)
    return Subsets(*(_edge_score(rows(estimates, mask)) for mask in masks))


def _edge_score(estimates: Estimates) -> EdgeScore:
    rre, rte, rmse = estimates.rre, estimates.rte, estimates.rmse
    success, answered = successes(rre, rte), estimates.answered
    return EdgeScore(
        edges=len(rre),
        answered=int(answered.sum()),
        recall=recall(success),
        recall_challenge=recall(successes(rre, rte, max_rte=MAX_RTE_CHALLENGE)),
        rte=_mean(rte[success]),
        rre=_mean(rre[success]),
        rte_answered=_mean(rte[answered]),
        rre_answered=_mean(rre[answered]),
        rmse=_mean(rmse[np.isfinite(rmse)]),
    )


def _map_score(
    evaluation: Evaluation, placements: Placements, chosen: Booleans, graphs: set[int]
) -> MapScore:
    sizes = [size for graph in sorted(graphs) for size in evaluation.components[graph]]
    here = rows(placements, np.isin(placements.graph, sorted(graphs)))
    placed_points = float(here.points[here.placed].sum())
    points = float(here.points.sum())
    official = [
        np.sqrt(_mean_square(here.official_squares[mask], here.points[mask]))
        for mask in (here.graph == graph for graph in sorted(graphs))
    ]
    return MapScore(
        fragments=len(here.ids),
        placed=int(here.placed.sum()),
        placed_elsewhere=sum(sizes) - int(here.placed.sum()),
        components=len(sizes),
        component_sizes=tuple(sizes),
        recall_main=recall(in_main_successes(evaluation.edges)[chosen]),
        outlier_f1=f1_score(here.outlier, ~here.placed) if here.outlier.any() else 100.0,
        global_rmse=float(np.sqrt(here.squares.sum() / placed_points)) if placed_points else NAN,
        coverage=placed_points / points * 100 if points else NAN,
        official_global_rmse=_mean(np.array(official)),
    )


def _mean_square(squares: Floats, points: Floats) -> float:
    return float(squares.sum() / points.sum()) if points.sum() else NAN


def bin_numbers(ratio: Floats) -> list[tuple[tuple[float, float], Booleans]]:
    """The bins of `BIN_WIDTH` that are not empty: their ends, and which values (n,) lie in them.

    The last bin holds its upper end too; NaN lies in none.
    """
    last = round(1 / BIN_WIDTH) - 1
    known = np.isfinite(ratio)
    # The small number: 0.3 / 0.1 is less than 3.
    number = np.full(len(ratio), -1)
    number[known] = np.clip(np.floor(ratio[known] / BIN_WIDTH + 1e-9), 0, last)
    return [
        ((round(i * BIN_WIDTH, 9), round((i + 1) * BIN_WIDTH, 9)), number == i)
        for i in np.unique(number[known]).tolist()
    ]


def _bins(edges: Edges, ratio: Floats) -> tuple[BinScore, ...]:
    kinds = dict(zip(KINDS, _kinds(edges.same_stage), strict=True))
    hits = successes(edges.pairwise.rre, edges.pairwise.rte)
    placed = successes(edges.multiway.rre, edges.multiway.rte) if edges.multiway else None
    bins = []
    for (low, high), inside in bin_numbers(ratio):
        masks = {kind: mask & inside for kind, mask in kinds.items()}
        bins.append(
            BinScore(
                low=low,
                high=high,
                edges={kind: int(mask.sum()) for kind, mask in masks.items()},
                pairwise={kind: recall(hits[mask]) for kind, mask in masks.items()},
                multiway=None
                if placed is None
                else {kind: recall(placed[mask]) for kind, mask in masks.items()},
            )
        )
    return tuple(bins)


def _overlap_score(answers: Answers, scores: Floats, least: float) -> OverlapScore:
    given, known = np.isfinite(scores), np.isfinite(answers.overlap)
    both, same, different = (
        classify(answers.overlap[mask] == 1, scores[mask], least)
        for mask in (known & kind for kind in _kinds(answers.same_stage))
    )
    return OverlapScore(both, same, different, int((~given).sum()), int((given & ~known).sum()))


def _calibration_score(answers: Answers) -> CalibrationScore:
    known = np.isfinite(answers.rte)
    right = successes(answers.rre, answers.rte)
    return CalibrationScore(
        *(
            calibrate(right[mask], answers.confidence[mask])
            for mask in (known & kind for kind in _kinds(answers.same_stage))
        )
    )


def _kinds(same: Booleans) -> tuple[Booleans, Booleans, Booleans]:
    """Masks of all, same stage and different stage, in the order of `KINDS`."""
    return np.ones(len(same), dtype=bool), same, ~same


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else NAN
