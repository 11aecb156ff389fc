"""The figures of logs, as charts: after the NSS paper's figures of its evaluation.

Everywhere blue is same-stage and orange different-stage; a dashed line is the relative
transforms, a solid one the poses of the map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nss_ros.benchmark.chart import (
    Axis,
    Chart,
    Mark,
    Panel,
    Series,
    distribution,
    spread,
)
from nss_ros.benchmark.evaluation import Booleans, Evaluation
from nss_ros.benchmark.headline import KINDS
from nss_ros.benchmark.metrics import MAX_RRE, MAX_RTE, MAX_RTE_CHALLENGE, Floats
from nss_ros.benchmark.run import Run
from nss_ros.benchmark.score import BIN_WIDTH, BinScore, LogScore
from nss_ros.benchmark.timing_chart import timing_chart
from nss_ros.colors import STAGE_COLORS

COLOURS = {"all": "#333333", "same_stage": "#0072B2", "different_stage": "#D55E00"}
"""Of kinds of pairs, in every chart."""
NAMES = {"all": "all", "same_stage": "same stage", "different_stage": "different stages"}

_RECALL = Axis("recall (%)", 0.0, 104.0)


def run_charts(run: Run) -> dict[str, Chart]:
    """All charts of one run for which it holds the data, by name, in the order of reading."""
    charts: dict[str, Chart | None] = {}
    if run.score is not None and run.evaluation is not None:
        charts = {
            "recall_by_overlap": recall_by_bin(run.score, "overlap"),
            "recall_by_change": recall_by_bin(run.score, "change"),
            "error_distributions": error_distributions(run.evaluation),
            "rmse_change": rmse_change(run.evaluation),
            "precision_recall": precision_recall(run.score),
            "reliability": reliability(run.score),
        }
    charts["timing"] = timing_chart(run.timing)
    return {name: chart for name, chart in charts.items() if chart is not None}


def missing_charts(run: Run) -> list[str]:
    """One sentence for each chart for which a run that was scored lacks the data."""
    score, evaluation = run.score, run.evaluation
    if score is None or evaluation is None:
        return []
    missing = (
        (not score.overlap_bins, "The ground truth tells no overlap ratios: no recall by overlap."),
        (
            not score.change_bins,
            "The ground truth tells no temporal change ratios: no recall by change.",
        ),
        (
            precision_recall(score) is None,
            "No precision-recall curve: that takes overlap probabilities of pairs that overlap and "
            "of pairs that do not.",
        ),
        (reliability(score) is None, "No answer has a confidence and a known truth."),
        (
            rmse_change(evaluation) is None,
            "No change of the pairwise RMSE: that takes a map and point clouds.",
        ),
    )
    return [sentence for lacks, sentence in missing if lacks]


def recall_by_bin(score: LogScore, by: str) -> Chart | None:
    """Recall by overlap ratio (`by` is `overlap`) or temporal change ratio (`change`).

    None if the ground truth gives no such ratios.
    """
    bins = score.overlap_bins if by == "overlap" else score.change_bins
    if not bins:
        return None
    what = "overlap ratio" if by == "overlap" else "temporal change ratio"
    axis = Axis(what, 0.0, 1.0)
    series = [
        _recall_series(bins, kind, way)
        for kind in KINDS[1:]
        for way in (("pairwise", "map") if score.overall.multiway is not None else ("pairwise",))
    ]
    counts = tuple(
        Series(
            "",
            np.array([(b.low + b.high) / 2 + offset * BIN_WIDTH for b in bins]),
            np.array([float(b.edges[kind]) for b in bins]),
            COLOURS[kind],
            Mark.BARS,
            tuple(f"{_span(b)}<br>{b.edges[kind]:,} edges, {NAMES[kind]}" for b in bins),
            width=0.38 * BIN_WIDTH,
            alpha=0.75,
        )
        for kind, offset in zip(KINDS[1:], (-0.2, 0.2), strict=True)
    )
    return Chart(
        f"Recall by {what}",
        (
            Panel(axis, _RECALL, tuple(s for s in series if len(s.x))),
            Panel(axis, Axis("edges", 0.0), counts, height=0.5),
        ),
        f"Recall within 10 deg and 0.2 m, in bins of {BIN_WIDTH:g}; below, how many edges are in "
        "each.",
    )


def _recall_series(bins: Sequence[BinScore], kind: str, way: str) -> Series:
    known = [each for each in bins if each.edges[kind]]
    recalls = [
        (each.pairwise if way == "pairwise" else each.multiway or {}).get(kind, float("nan"))
        for each in known
    ]
    return Series(
        f"{way}, {NAMES[kind]}",
        np.array([(each.low + each.high) / 2 for each in known]),
        np.array(recalls),
        COLOURS[kind],
        Mark.DASHED_POINTS if way == "pairwise" else Mark.LINE_POINTS,
        tuple(
            f"{_span(each)}<br>{way}, {NAMES[kind]}: {value:.1f} %<br>of {each.edges[kind]:,} edges"
            for each, value in zip(known, recalls, strict=True)
        ),
    )


def _span(each: BinScore) -> str:
    return f"{each.low:g} to {each.high:g}"


def precision_recall(score: LogScore) -> Chart | None:
    """Precision against recall of overlap classification; None without probabilities."""
    series = []
    for kind in KINDS:
        curve = getattr(score.overlap, kind)
        if curve is None or not curve.curve:
            continue
        thresholds, precision, recall = np.array(curve.curve).T
        series.append(
            Series(
                f"{NAMES[kind]}, AP {curve.average_precision:.3f}",
                recall,
                precision,
                COLOURS[kind],
                hover=tuple(
                    f"threshold {t:.3f}<br>precision {p:.3f}, recall {r:.3f}"
                    for t, p, r in zip(thresholds, precision, recall, strict=True)
                ),
            )
        )
    if not series:
        return None
    panel = Panel(Axis("recall", 0.0, 1.02), Axis("precision", 0.0, 1.02), tuple(series))
    return Chart(
        "Overlap classification",
        (panel,),
        "Does the method know which fragments overlap? Truth: overlap ratio of at least 0.1.",
    )


def reliability(score: LogScore) -> Chart | None:
    """Share of right estimates against their confidence; None without estimates."""
    series = [Series("", np.array([0.0, 1.0]), np.array([0.0, 1.0]), "#bbbbbb", size=1.2)]
    for kind in KINDS[1:]:
        calibration = getattr(score.calibration, kind)
        bins = [each for each in calibration.curve if each.count] if calibration else []
        if bins:
            series.append(
                Series(
                    f"{NAMES[kind]}, ECE {calibration.expected_error:.3f}",
                    np.array([each.confidence for each in bins]),
                    np.array([each.accuracy for each in bins]),
                    COLOURS[kind],
                    Mark.LINE_POINTS,
                    tuple(
                        f"confidence {each.confidence:.2f}<br>{each.accuracy:.0%} right of "
                        f"{each.count:,}"
                        for each in bins
                    ),
                )
            )
    if len(series) == 1:
        return None
    panel = Panel(
        Axis("mean confidence", 0.0, 1.02), Axis("share that is right", 0.0, 1.02), tuple(series)
    )
    return Chart(
        "Reliability of the confidence",
        (panel,),
        "On the diagonal a confidence means what it says: above it is too low, below too high.",
    )


def error_distributions(evaluation: Evaluation) -> Chart | None:
    """Cumulative distributions of RRE and RTE over all edges; None without edges."""
    edges = evaluation.edges
    if not len(edges.pairs):
        return None
    ways = [("pairwise", edges.pairwise)]
    if edges.multiway is not None:
        ways.append(("map", edges.multiway))
    rotation, translation = [], []
    for kind, mask in _kinds(edges.same_stage):
        for way, estimates in ways:
            rotation.append(_cumulative(estimates.rre, mask, kind, way, "deg"))
            translation.append(_cumulative(estimates.rte, mask, kind, way, "m"))
    percent = Axis("edges (%)", 0.0, 102.0)
    return Chart(
        "Distribution of errors",
        (
            Panel(
                Axis("RRE (deg)", 0.01, 180.0, log=True),
                percent,
                tuple(s for s in rotation if len(s.x)),
                marks=((MAX_RRE, "10 deg"),),
            ),
            Panel(
                Axis("RTE (m)", 0.001, 30.0, log=True),
                percent,
                tuple(s for s in translation if len(s.x)),
                marks=((MAX_RTE, "0.2 m"), (MAX_RTE_CHALLENGE, "")),
            ),
        ),
        "Share of all edges whose error is at most so large. Edges without an estimate never come "
        "up, so a curve may end below 100 %. Dotted: the limits of a success.",
        columns=2,
    )


def _cumulative(values: Floats, mask: Booleans, kind: str, way: str, unit: str) -> Series:
    known = values[mask & np.isfinite(values)]
    x, y = distribution(np.maximum(known, 1e-9), int(mask.sum()))
    if len(x):
        x, y = np.append(x, 1e3), np.append(y, y[-1])
    name = f"{way}, {NAMES[kind]}"
    return Series(
        name,
        x,
        y,
        COLOURS[kind],
        Mark.DASHED if way == "pairwise" else Mark.LINE,
        tuple(f"{name}<br>{p:.1f} % within {v:.3g} {unit}" for v, p in zip(x, y, strict=True)),
    )


def rmse_change(evaluation: Evaluation) -> Chart | None:
    """Percentiles of the change in pairwise RMSE from the transforms to the map's poses.

    None without a map, or without point clouds.
    """
    multiway = evaluation.edges.multiway
    if multiway is None:
        return None
    change = multiway.rmse - evaluation.edges.pairwise.rmse
    series = []
    for kind, mask in _kinds(evaluation.edges.same_stage):
        values = np.sort(change[mask & np.isfinite(change)])
        if not len(values):
            continue
        percent = 100 * (np.arange(len(values)) + 0.5) / len(values)
        chosen = spread(len(values))
        better = 100 * float((values < 0).mean())
        series.append(
            Series(
                f"{NAMES[kind]} ({len(values):,} edges, {better:.0f} % improved)",
                percent[chosen],
                values[chosen],
                COLOURS[kind],
                hover=tuple(
                    f"{NAMES[kind]}<br>percentile {p:.0f}: {v:+.3f} m"
                    for p, v in zip(percent[chosen], values[chosen], strict=True)
                ),
            )
        )
    if not series:
        return None
    zero = Series("", np.array([0.0, 100.0]), np.zeros(2), "#bbbbbb", size=1.2)
    panel = Panel(
        Axis("percentile of edges", 0.0, 100.0), Axis("change in RMSE (m)"), (zero, *series)
    )
    return Chart(
        "Change of the pairwise RMSE by the multi-way step",
        (panel,),
        "Below zero the map's poses fit a pair better than its own registration did. Edges that "
        "have both.",
    )


def rmse_by_graph_size(scores: Sequence[LogScore]) -> Chart | None:
    """Global RMSE of each graph against its number of fragments; None with fewer than two."""
    graphs = [
        (score, graph)
        for score in scores
        for graph in score.graphs
        if graph.map is not None and np.isfinite(graph.map.global_rmse)
    ]
    if len(graphs) < 2:
        return None
    series = []
    for number, score in enumerate(scores):
        maps = [(g.name, g.map) for of, g in graphs if of is score and g.map is not None]
        if maps:
            series.append(
                Series(
                    score.log.rstrip("/").rsplit("/", 1)[-1] if len(scores) > 1 else "",
                    np.array([float(each.fragments) for _, each in maps]),
                    np.array([max(each.global_rmse, 1e-6) for _, each in maps]),
                    STAGE_COLORS[number % len(STAGE_COLORS)],
                    Mark.POINTS,
                    tuple(
                        f"{name}<br>{each.fragments:,} fragments, {each.coverage:.0f} % covered"
                        f"<br>global RMSE {each.global_rmse:.3f} m"
                        for name, each in maps
                    ),
                    size=8,
                )
            )
    panel = Panel(
        Axis("fragments in the graph", 0.0), Axis("global RMSE (m)", log=True), tuple(series)
    )
    return Chart(
        "Global RMSE against the size of the graph",
        (panel,),
        "One point per graph; over the points of its main component.",
    )


def _kinds(same_stage: Booleans) -> tuple[tuple[str, Booleans], tuple[str, Booleans]]:
    return (KINDS[1], same_stage), (KINDS[2], ~same_stage)
