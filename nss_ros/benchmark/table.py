"""Scores as tables, by name; one structure for terminal, files and report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from nss_ros.benchmark.calibration import Calibration
from nss_ros.benchmark.challenge import SUBSETS, ChallengeMetrics, ChallengeScore
from nss_ros.benchmark.headline import KINDS
from nss_ros.benchmark.published import PublishedRecall, published
from nss_ros.benchmark.score import BinScore, GraphScore, LogScore, MapScore, Subsets
from nss_ros.multiway.pose_graph import doubtful_sentence
from nss_ros.table import Align, Cell, Column, Table

OFFICIAL_NAMES = {
    "global_rmse": ("Global RMSE", "m"),
    "outlier_f1": ("Outlier F1", "%"),
    "pairwise_rmse": ("Pairwise RMSE", "m"),
    "recall": ("Registration Recall", "%"),
    "translation_error": ("Average Translation Error", "m"),
    "rotation_error": ("Average Rotation Error", "deg"),
}
KIND_NAMES = {"all": "all", "same_stage": "same", "different_stage": "different"}
"""Of edges and pairs, by the stages of their fragments."""
_ERRORS = (
    "Stages: edges within one stage, or between different ones. Recall: RRE <= 10 deg and RTE <= "
    "0.2 m, or 0.1 m where it says so. RTE, RRE: mean over "
    "successes at 0.2 m; of all: over all answered edges."
)
_SAME_STAGE_TRAINING = "same_stage"
Row = tuple[Cell, ...]


def log_tables(score: LogScore) -> dict[str, Table]:
    """All tables of one log, by name, in the order of reading."""
    # With a single graph its rows would repeat the overall ones.
    graphs = (*score.graphs, score.overall) if len(score.graphs) > 1 else score.graphs
    tables = {
        "pairwise": _edge_table(
            "Pairwise: relative transforms", _named(graphs, "pairwise"), _ERRORS
        ),
    }
    if score.overall.multiway is not None:
        tables["multiway"] = _edge_table(
            "Multi-way: the map's poses",
            _named(graphs, "multiway"),
            "Answered: both fragments are in one component of the map.",
        )
        tables["map"] = _map_table([(g.name, g.map) for g in graphs if g.map is not None])
    if len(score.areas) > 1:
        tables["areas"] = area_table(score)
    if score.displacements:
        tables["displacement"] = displacement_table(score)
    return tables | _shared_tables([score]) | {"intervals": interval_table(score)}


def run_tables(scores: Sequence[LogScore]) -> dict[str, Table]:
    """All tables of several runs side by side, by name, in the order of reading.

    Args:
        scores: of runs; the order of the rows.
    """
    tables = {"pairwise": pairwise_table(scores)}
    if any(score.training for score in scores):
        tables["training"] = training_table(scores)
    if any(score.overall.map is not None for score in scores):
        tables["multiway"] = multiway_table(scores)
        names = run_names(scores)
        maps = zip(names, (score.overall.map for score in scores), strict=True)
        tables["map"] = _map_table([(n, m) for n, m in maps if m is not None], "run")
    return tables | _shared_tables(scores)


def notes(score: LogScore) -> list[str]:
    """What a reader of a score has to know first: what is missing in the log."""
    result = []
    if score.truncated:
        result.append("PARTIAL: the log is truncated or was never closed.")
    if score.answered < score.pairs:
        result.append(
            f"PARTIAL: {score.pairs - score.answered} of {score.pairs} pairs have no answer; they "
            "count as misses."
        )
    if score.failed:
        result.append(f"{score.failed} of {score.pairs} pairs failed; they count as misses.")
    if not score.has_points:
        result.append("The log holds no point clouds of these graphs: no RMSE.")
    if score.overall.multiway is None:
        result.append("The log holds no map, so there are no multi-way figures.")
    result += [sentence for graph in score.graphs if (sentence := _in_parts(graph))]
    if score.doubtful:
        result.append(doubtful_sentence(score.doubtful))
    return result


def _in_parts(graph: GraphScore) -> str:
    """What is in which component, of a graph whose map is not whole; empty of one that is."""
    if graph.map is None or graph.multiway is None or graph.map.components < 2:
        return ""
    figures = graph.map
    sizes = ", ".join(map(str, figures.component_sizes[1:]))
    unplaced = figures.fragments - figures.placed - figures.placed_elsewhere
    return (
        f"{graph.name} is in {figures.components} components that no accepted edge links: placed "
        f"in the main component: {figures.placed} of {figures.fragments} fragments; in the others: "
        f"{sizes}; in none: {unplaced}. Map recall takes edges within any component "
        f"({graph.multiway.all.recall:.1f} %; in the main component alone "
        f"{figures.recall_main:.1f} %); edges that the map does not link are misses. Global RMSE, "
        "coverage and outlier F1 are of the main component, as a submission to the challenge is."
    )


def run_names(
    scores: Sequence[LogScore], maps_apart: bool = False, training_apart: bool = False
) -> list[str]:
    """The method of each run, with its training if needed; or the log's name if not enough.

    Args:
        scores: of the runs.
        maps_apart: the multi-way method is told beside the name.
        training_apart: what the method was trained on is told beside the name.
    """
    keys = [
        (score.split, score.method, score.synchronizer if maps_apart else "") for score in scores
    ]
    trained = [(*key, score.training) for key, score in zip(keys, scores, strict=True)]
    count, count_trained = Counter(keys), Counter(trained)
    names = []
    for score, key, key_trained in zip(scores, keys, trained, strict=True):
        if not score.method or count_trained[key_trained] > 1:
            names.append(Path(score.log).name)
        elif count[key] == 1 or training_apart or not score.training:
            names.append(score.method)
        else:
            names.append(f"{score.method}, trained on {_words(score.training)}")
    return names


def _words(training: str) -> str:
    """What a method was trained on, for people."""
    return training.replace("_", " ")


def pairwise_table(scores: Sequence[LogScore]) -> Table:
    """The paper's pairwise table: recall and errors of every split and method, by kind of edge.

    The published figures stand below those of the same split, or below all.
    """
    rows: list[Row] = []
    ours = list(zip(scores, run_names(scores), strict=True))
    splits = list(dict.fromkeys([*(s.split for s in scores), *(p.split for p in _published())]))
    for split in sorted(splits):
        for score, name in ours:
            if score.split == split:
                rows.append((split or None, name, *_pairwise_cells(score)))
        for paper in _published():
            if paper.split == split:
                rows.append((split, f"{paper.method} *", *_published_cells(paper)))
    return Table(
        "Pairwise registration",
        (
            Column("split", align=Align.LEFT),
            Column("method", align=Align.LEFT),
            *_pairwise_columns(),
        ),
        tuple(rows),
        f"Recall: RRE <= 10 deg and RTE <= 0.2 m; RTE, RRE: mean over successes. {_starred()}",
    )


def training_table(scores: Sequence[LogScore]) -> Table:
    """The paper's table of methods trained on same-stage pairs only, beside the others.

    Recall and errors of every split and method, by kind of edge. Runs that do not tell their
    training are shown where another of their split and method does. The published figures stand
    below those of the same split, if they are at hand.
    """
    told = {(score.split, score.method) for score in scores if score.training}
    ours = [
        (score, name)
        for score, name in zip(scores, run_names(scores, training_apart=True), strict=True)
        if (score.split, score.method) in told
    ]
    ours.sort(key=lambda run: (run[1], run[0].training == _SAME_STAGE_TRAINING))
    theirs = published().training
    rows: list[Row] = []
    splits = dict.fromkeys([*(score.split for score, _ in ours), *(p.split for p in theirs)])
    for split in sorted(splits):
        rows += [
            (split or None, name, _words(score.training) or "not told", *_pairwise_cells(score))
            for score, name in ours
            if score.split == split
        ]
        rows += [
            (split, f"{paper.method} *", _words(paper.training), *_published_cells(paper))
            for paper in theirs
            if paper.split == split
        ]
    return Table(
        "Trained on same-stage pairs only",
        (
            Column("split", align=Align.LEFT),
            Column("method", align=Align.LEFT),
            Column("trained on", align=Align.LEFT),
            *_pairwise_columns(),
        ),
        tuple(rows),
        "Recall: RRE <= 10 deg and RTE <= 0.2 m; RTE, RRE: mean over successes. "
        + (_starred() if theirs else "The published figures of this table are not at hand."),
    )


def _pairwise_columns() -> list[Column]:
    return [
        column
        for kind in KIND_NAMES.values()
        for column in (
            Column(f"recall, {kind}", "%", ".1f"),
            Column(f"RTE, {kind}", "m", ".3f"),
            Column(f"RRE, {kind}", "deg", ".2f"),
        )
    ]


def _pairwise_cells(score: LogScore) -> list[Cell]:
    kinds = [getattr(score.overall.pairwise, kind) for kind in KINDS]
    return [cell for kind in kinds for cell in (kind.recall, kind.rte, kind.rre)]


def _published_cells(paper: PublishedRecall) -> list[Cell]:
    return [None, None, None, paper.same_stage, None, None, paper.different_stage, None, None]


def multiway_table(scores: Sequence[LogScore]) -> Table:
    """The paper's multi-way table: the relative transforms, then each synchronizer's map."""
    rows: list[Row] = []
    names = run_names(scores, maps_apart=True)
    any_split = any(score.split for score in scores)
    shown: set[tuple[str, str, tuple[float, ...]]] = set()
    for score, name in zip(scores, names, strict=True):
        for way, subsets in (
            ("-", score.overall.pairwise),
            (score.synchronizer or "?", score.overall.multiway),
        ):
            if subsets is None:
                continue
            figures = (subsets.all.recall, subsets.all.rte_answered, subsets.all.rre_answered)
            # Maps made of the same relative transforms share that row.
            if way == "-" and (score.split, score.method, figures) in shown:
                continue
            shown.add((score.split, score.method, figures))
            map_ = score.overall.map if way != "-" else None
            rows.append(
                (
                    *([score.split or None] if any_split else []), name, way, subsets.all.rmse,
                    map_.global_rmse if map_ else None,
                    *(subsets.all.recall, subsets.all.rte, subsets.all.rre),
                    *(subsets.same_stage.recall, subsets.different_stage.recall),
                    map_.components if map_ else None,
                    map_.recall_main if map_ else None,
                    map_.official_global_rmse if map_ else None,
                )
            )  # fmt: skip
    return Table(
        "Multi-way registration",
        (
            *([Column("split", align=Align.LEFT)] if any_split else []),
            Column("pairwise", align=Align.LEFT),
            Column("multi-way", align=Align.LEFT),
            Column("RMSE^P", "m", ".3f"),
            Column("RMSE^G", "m", ".3f"),
            Column("recall", "%", ".1f"),
            Column("RTE", "m", ".3f"),
            Column("RRE", "deg", ".2f"),
            Column("recall, same", "%", ".1f"),
            Column("recall, different", "%", ".1f"),
            Column("components", form=","),
            Column("recall, main", "%", ".1f"),
            Column("official RMSE^G", "m", ".3f"),
        ),
        tuple(rows),
        "RMSE^P: mean over answered edges. RMSE^G: over the main component; official: all "
        "fragments, as the challenge has it. Recall: RRE <= 10 deg and RTE <= 0.2 m, within any "
        "component of the map, or within the main one alone; RTE, RRE: mean over successes.",
    )


def bin_table(scores: Sequence[LogScore], by: str) -> Table:
    """Recall by overlap ratio (`by` is `overlap`) or temporal change ratio (`change`).

    Of a single run with a map also the recall of the map's poses.
    """
    several = len(scores) > 1
    mapped = not several and scores[0].overall.multiway is not None
    rows: list[Row] = []
    for score, name in zip(scores, run_names(scores), strict=True):
        for each in _bins(score, by):
            cells: list[Cell] = [name] if several else []
            cells.append(span(each.low, each.high))
            for kind in KINDS[1:]:
                cells += [each.edges[kind], each.pairwise[kind]]
                if mapped:
                    cells.append(each.multiway[kind] if each.multiway is not None else None)
            rows.append(tuple(cells))
    what = "overlap ratio" if by == "overlap" else "temporal change ratio"
    return Table(
        f"Recall by {what}",
        (
            *([Column("run", align=Align.LEFT)] if several else []),
            Column(what, align=Align.LEFT),
            *(
                column
                for kind in KINDS[1:]
                for column in (
                    Column(f"edges, {KIND_NAMES[kind]}", form=","),
                    Column(f"pairwise, {KIND_NAMES[kind]}", "%", ".1f"),
                    *([Column(f"multi-way, {KIND_NAMES[kind]}", "%", ".1f")] if mapped else []),
                )
            ),
        ),
        tuple(rows),
        "Recall: RRE <= 10 deg and RTE <= 0.2 m. Bins hold their lower end.",
    )


def overlap_table(scores: Sequence[LogScore]) -> Table:
    """Overlap classification by kind of pair: by the answers, and by the map."""
    several = len(scores) > 1
    with_map = any(score.map_overlap.all is not None for score in scores)
    rows: list[Row] = []
    left_out = 0
    for score, name in zip(scores, run_names(scores), strict=True):
        left_out += score.overlap.without_probability + score.overlap.unknown
        for by, overlap in (("pair", score.overlap), ("map", score.map_overlap)):
            for kind in KINDS:
                each = getattr(overlap, kind)
                if each is not None:
                    rows.append(
                        (
                            *([name] if several else []), *([by] if with_map else []),
                            KIND_NAMES[kind], each.pairs, each.overlapping,
                            each.mean_average_precision, each.auroc,
                            each.accuracy, each.precision, each.recall, each.f1,
                        )
                    )  # fmt: skip
    return Table(
        "Overlap classification",
        (
            *([Column("run", align=Align.LEFT)] if several else []),
            *([Column("by", align=Align.LEFT)] if with_map else []),
            Column("stages", align=Align.LEFT),
            Column("pairs", form=","),
            Column("overlap", form=","),
            *(
                Column(name, form=".3f")
                for name in ("mAP", "AUROC", "accuracy", "prec.", "recall", "F1")
            ),
        ),
        tuple(rows),
        "Truth: overlap ratio of at least 0.1."
        + (
            " By pair: the probability that the method reports, called from 0.5. By map: the "
            "overlap ratio at its poses, called from 0.1; 0 where it does not link the pair."
            if with_map
            else " Judged: the probability that the method reports, called from 0.5."
        )
        + " mAP: average precision, mean over both classes."
        + (f" Left out for want of a probability or of the truth: {left_out}." if left_out else ""),
    )


def calibration_table(scores: Sequence[LogScore]) -> Table:
    """How confidence and success agree, by kind of pair."""
    several = len(scores) > 1
    rows: list[Row] = []
    for score, name in zip(scores, run_names(scores), strict=True):
        for kind in KINDS:
            each = getattr(score.calibration, kind)
            if each is not None:
                rows.append(
                    (
                        *([name] if several else []), KIND_NAMES[kind], each.count,
                        each.confidence, each.accuracy, each.expected_error, each.brier, each.auroc,
                    )
                )  # fmt: skip
    return Table(
        "Confidence of relative transforms",
        (
            *([Column("run", align=Align.LEFT)] if several else []),
            Column("stages", align=Align.LEFT),
            Column("estimates", form=","),
            *(
                Column(name, form=".3f")
                for name in ("mean confidence", "share right", "ECE", "Brier", "AUROC")
            ),
        ),
        tuple(rows),
        "Right: RRE <= 10 deg and RTE <= 0.2 m. ECE: expected calibration error in ten bins. "
        "AUROC: of confidence against right and wrong.",
    )


def reliability_table(calibration: Calibration) -> Table:
    """The reliability curve."""
    return Table(
        "Reliability of the confidence",
        (
            Column("confidence", align=Align.LEFT),
            Column("estimates", form=","),
            Column("mean confidence", form=".3f"),
            Column("share right", form=".3f"),
        ),
        tuple(
            (span(each.low, each.high), each.count, each.confidence, each.accuracy)
            for each in calibration.curve
        ),
    )


def displacement_table(score: LogScore) -> Table:
    """Displacement of stages against each other in the map."""
    return Table(
        "Stages against each other in the map",
        (
            Column("area", align=Align.LEFT),
            Column("stage", form="d"),
            Column("against", form="d"),
            Column("fragments", form=","),
            Column("median", "m", ".3f"),
            Column("largest", "m", ".3f"),
        ),
        tuple(
            (each.area, each.other, each.stage, each.fragments, each.median, each.largest)
            for each in score.displacements
        ),
    )


def area_table(score: LogScore) -> Table:
    """Recall and global RMSE of each area, and micro-averaged."""
    rows: list[Row] = []
    for area in (*score.areas, score.overall):
        cells: list[Cell] = [area.name, area.pairwise.all.edges]
        cells += [getattr(area.pairwise, kind).recall for kind in KINDS]
        for kind in KINDS:
            cells.append(getattr(area.multiway, kind).recall if area.multiway else None)
        cells.append(area.map.global_rmse if area.map else None)
        rows.append(tuple(cells))
    return Table(
        "Areas",
        (
            Column("area", align=Align.LEFT),
            Column("edges", form=","),
            *(Column(f"pairwise, {kind}", "%", ".1f") for kind in KIND_NAMES.values()),
            *(Column(f"multi-way, {kind}", "%", ".1f") for kind in KIND_NAMES.values()),
            Column("global RMSE", "m", ".3f"),
        ),
        tuple(rows),
        "Recall: RRE <= 10 deg and RTE <= 0.2 m. Overall: micro average.",
    )


def interval_table(score: LogScore) -> Table:
    """All headline figures, by the names that gates use, with their bootstrap intervals."""
    return Table(
        "Headline figures with bootstrap intervals",
        (
            Column("name", align=Align.LEFT),
            Column("unit", align=Align.LEFT),
            Column("value", form=".3g"),
            Column("low", form=".3g"),
            Column("high", form=".3g"),
        ),
        tuple(
            (name, each.unit, each.value, each.low, each.high)
            for name, each in score.headline.items()
        ),
        "Percentile intervals; those of figures without spread in the sample have no width.",
    )


def challenge_tables(score: ChallengeScore) -> dict[str, Table]:
    """The official metrics: overall, then each scene if there are several."""
    tables = {"overall": _challenge_table("Overall", score.overall)}
    if len(score.scenes) > 1:
        tables |= {name: _challenge_table(name, scene) for name, scene in score.scenes.items()}
    return tables


def _shared_tables(scores: Sequence[LogScore]) -> dict[str, Table]:
    """What looks alike for one run and for many."""
    tables = {}
    for by in ("overlap", "change"):
        if any(_bins(score, by) for score in scores):
            tables[f"{by}_bins"] = bin_table(scores, by)
    if any(score.overlap.all is not None for score in scores):
        tables["overlap"] = overlap_table(scores)
    if any(score.calibration.all is not None for score in scores):
        tables["calibration"] = calibration_table(scores)
    if len(scores) == 1:
        tables["paper"] = pairwise_table(scores)
        if scores[0].training:
            tables["training"] = training_table(scores)
        if scores[0].calibration.all is not None:
            tables["reliability"] = reliability_table(scores[0].calibration.all)
    return tables


def _named(graphs: Iterable[GraphScore], way: str) -> list[tuple[str, Subsets]]:
    found = [(graph.name, getattr(graph, way)) for graph in graphs]
    return [(name, subsets) for name, subsets in found if subsets is not None]


def _edge_table(title: str, graphs: Sequence[tuple[str, Subsets]], caption: str = "") -> Table:
    several = len(graphs) > 1
    rows: list[Row] = []
    for name, subsets in graphs:
        for kind, label in KIND_NAMES.items():
            edge = getattr(subsets, kind)
            rows.append(
                (
                    *([name] if several else []), label, edge.edges, edge.answered, edge.recall,
                    edge.recall_challenge, edge.rte, edge.rre, edge.rte_answered,
                    edge.rre_answered, edge.rmse,
                )
            )  # fmt: skip
    return Table(
        title,
        (
            *([Column("graph", align=Align.LEFT)] if several else []),
            Column("stages", align=Align.LEFT),
            Column("edges", form=","),
            Column("answered", form=","),
            Column("recall 0.2 m", "%", ".1f"),
            Column("recall 0.1 m", "%", ".1f"),
            Column("RTE", "m", ".3f"),
            Column("RRE", "deg", ".2f"),
            Column("RTE of all", "m", ".3f"),
            Column("RRE of all", "deg", ".2f"),
            Column("RMSE", "m", ".3f"),
        ),
        tuple(rows),
        caption,
    )


def _map_table(maps: Sequence[tuple[str, MapScore]], heading: str = "graph") -> Table:
    return Table(
        "Map",
        (
            Column(heading, align=Align.LEFT),
            Column("nodes", form=","),
            Column("in main component", form=","),
            Column("in others", form=","),
            Column("components", form=","),
            Column("recall, main", "%", ".1f"),
            Column("outlier F1", "%", ".1f"),
            Column("global RMSE", "m", ".3f"),
            Column("coverage", "%", ".1f"),
            Column("official global RMSE", "m", ".3f"),
        ),
        tuple(
            (
                name, each.fragments, each.placed, each.placed_elsewhere, each.components,
                each.recall_main, each.outlier_f1, each.global_rmse, each.coverage,
                each.official_global_rmse,
            )
            for name, each in maps
        ),
        "Main: the largest component; recall, RMSE, F1 and coverage of this table are of it alone. "
        "Global RMSE: over the points of its fragments, which the coverage counts; official: as "
        "the challenge has it.",
    )  # fmt: skip


def _challenge_table(title: str, subsets: Mapping[str, ChallengeMetrics]) -> Table:
    rows: list[Row] = []
    for attribute, (name, unit) in OFFICIAL_NAMES.items():
        values = [getattr(subsets[subset], attribute) for subset in SUBSETS]
        if None not in values:
            rows.append((f"{name} [{unit}]", *values))
    return Table(
        title,
        (
            Column("official metric", align=Align.LEFT),
            *(Column(subset, form=".3f") for subset in SUBSETS),
        ),
        tuple(rows),
    )


def _bins(score: LogScore, by: str) -> tuple[BinScore, ...]:
    return score.overlap_bins if by == "overlap" else score.change_bins


def span(low: float, high: float) -> str:
    """A bin as people read it."""
    return f"{low:g}-{high:g}"


def _published() -> tuple[PublishedRecall, ...]:
    return published().pairwise


def _starred() -> str:
    return f"* Published, on other data: the NSS data set; {published().source}."
