"""Scores as tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from nss_ros.benchmark.challenge import SUBSETS, ChallengeMetrics, ChallengeScore
from nss_ros.benchmark.score import GraphScore, LogScore, Subsets

OFFICIAL_NAMES = {
    "global_rmse": ("Global RMSE", "m"),
    "outlier_f1": ("Outlier F1", "%"),
    "pairwise_rmse": ("Pairwise RMSE", "m"),
    "recall": ("Registration Recall", "%"),
    "translation_error": ("Average Translation Error", "m"),
    "rotation_error": ("Average Rotation Error", "deg"),
}
_LEGEND = (
    "Recall and F1 in percent, RTE and RMSE in metres, RRE in degrees. Recall: RRE <= 10 deg and "
    "RTE as stated. RTE, RRE: mean over successes (0.2 m); all: over all answered edges."
)
_SUBSET_NAMES = {"all": "all", "same_stage": "same stage", "different_stage": "different stage"}


def log_tables(score: LogScore) -> RenderableType:
    """A log's score: what is incomplete first, then pairwise, multi-way and map."""
    # With a single graph its rows would repeat the overall ones.
    graphs = (*score.graphs, score.overall) if len(score.graphs) > 1 else score.graphs
    parts: list[RenderableType] = list(_banners(score))
    parts.append(Text(_LEGEND, "dim"))
    parts.append(
        _edge_table("Pairwise: relative transforms", [(g.name, g.pairwise) for g in graphs])
    )
    multiway = [(g.name, g.multiway) for g in graphs if g.multiway is not None]
    if multiway:
        parts.append(_edge_table("Multi-way: the map's poses", multiway))
        parts.append(_map_table(graphs))
    else:
        parts.append(Text("The log holds no map, so there are no multi-way figures.", "yellow"))
    return Group(*parts)


def challenge_tables(score: ChallengeScore) -> RenderableType:
    """The official metrics: overall, then each scene if there are several."""
    parts: list[RenderableType] = [Text(note, "yellow") for note in score.notes]
    parts.append(_challenge_table("Overall", score.overall))
    if len(score.scenes) > 1:
        parts += [_challenge_table(name, subsets) for name, subsets in score.scenes.items()]
    return Group(*parts)


def _banners(score: LogScore) -> Iterable[Text]:
    if score.truncated:
        yield Text("PARTIAL: the log is truncated or was never closed.", "bold yellow")
    if score.answered < score.pairs:
        yield Text(
            f"PARTIAL: {score.pairs - score.answered} of {score.pairs} pairs have no answer; they "
            "count as misses.",
            "bold yellow",
        )
    if score.failed:
        yield Text(f"{score.failed} of {score.pairs} pairs failed; they count as misses.")
    if not score.has_points:
        yield Text("The log holds no point clouds of these graphs: no RMSE.", "yellow")


def _edge_table(title: str, rows: Sequence[tuple[str, Subsets]]) -> Table:
    table = _table(title)
    table.add_column("between", no_wrap=True)
    for column in (
        "edges\nanswered", "recall\n0.2 m", "recall\n0.1 m", "RTE", "RRE", "RTE\nall", "RRE\nall",
        "RMSE",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for name, subsets in rows:
        if len(rows) > 1:
            table.add_row(Text(name, "bold"))
        for attribute, label in _SUBSET_NAMES.items():
            edge = getattr(subsets, attribute)
            table.add_row(
                label, f"{edge.answered}/{edge.edges}",
                _number(edge.recall, 1), _number(edge.recall_challenge, 1),
                _number(edge.rte, 3), _number(edge.rre, 2),
                _number(edge.rte_answered, 3), _number(edge.rre_answered, 2),
                _number(edge.rmse, 3),
            )  # fmt: skip
    return table


def _map_table(graphs: Iterable[GraphScore]) -> Table:
    table = _table("Map")
    table.add_column("graph", no_wrap=True)
    for column in (
        "placed", "components", "outlier\nF1", "global\nRMSE", "coverage\nof points",
        "official\nglobal RMSE",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for graph in graphs:
        if graph.map is not None:
            table.add_row(
                graph.name,
                f"{graph.map.placed}/{graph.map.fragments}",
                str(graph.map.components),
                _number(graph.map.outlier_f1, 1),
                _number(graph.map.global_rmse, 3),
                _number(graph.map.coverage, 1),
                _number(graph.map.official_global_rmse, 3),
            )
    return table


def _challenge_table(title: str, subsets: Mapping[str, ChallengeMetrics]) -> Table:
    table = _table(title)
    table.add_column("official metric")
    for subset in SUBSETS:
        table.add_column(subset, justify="right")
    for attribute, (name, unit) in OFFICIAL_NAMES.items():
        values = [getattr(subsets[subset], attribute) for subset in SUBSETS]
        if None not in values:
            table.add_row(f"{name} \\[{unit}]", *(_number(value, 3) for value in values))
    return table


def _table(title: str) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
    )


def _number(value: float, digits: int) -> str:
    if isfinite(value):
        return f"{value:.{digits}f}"
    return "inf" if value == float("inf") else "-"
