"""Comparisons as tables, by name."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from pathlib import Path

from nss_ros.benchmark.comparison import BinDifference, Comparison
from nss_ros.benchmark.headline import FIGURES, KINDS
from nss_ros.benchmark.table import KIND_NAMES, Row, span
from nss_ros.table import Align, Column, Table

_COMPARED = (
    *(f"recall_{kind}" for kind in KINDS), "recall_challenge_all", "rte_all", "rre_all", "rmse_all",
    *(f"multiway_recall_{kind}" for kind in KINDS), "multiway_recall_challenge_all",
    "multiway_rte_all", "multiway_rre_all", "multiway_rmse_all", "global_rmse",
    "official_global_rmse", "coverage", "outlier_f1", "overlap_mean_average_precision",
    "overlap_auroc", "map_overlap_auroc", "confidence_error", "confidence_auroc",
)  # fmt: skip


def comparison_tables(comparison: Comparison) -> dict[str, Table]:
    """The tables of a comparison, by name."""
    tables = {"figures": _difference_table(comparison)}
    for name, what, bins in (
        ("overlap_bins", "overlap ratio", comparison.overlap_bins),
        ("change_bins", "temporal change ratio", comparison.change_bins),
    ):
        if bins:
            tables[name] = _bin_difference_table(what, bins)
    tables["pairs"] = _changes_table(comparison)
    tables["intervals"] = _interval_table(comparison)
    return tables


def _difference_table(comparison: Comparison) -> Table:
    verdicts = {True: "better", False: "worse", None: None}
    return Table(
        _title(comparison),
        (
            Column("figure", align=Align.LEFT),
            Column("unit", align=Align.LEFT),
            Column("baseline", form=".3g"),
            Column("this", form=".3g"),
            Column("difference", form="+.3g"),
            Column("p", form=".3f"),
            Column("verdict", align=Align.LEFT),
        ),
        tuple(
            (
                FIGURES[name].title, each.unit, each.baseline, each.value, each.difference,
                each.p_value, verdicts[each.better],
            )
            for name, each in comparison.differences.items()
            if name in _COMPARED and not isnan(each.difference)
        ),
        f"Over {comparison.edges} edges and {comparison.fragments} fragments that both logs have. "
        "Recall: 10 deg, 0.2 m unless stated. p: two-sided, paired bootstrap. Verdict: where the "
        "interval of the difference does not hold zero (--table intervals).",
    )  # fmt: skip


def _interval_table(comparison: Comparison) -> Table:
    return Table(
        f"{_title(comparison)}: bootstrap intervals",
        (
            Column("figure", align=Align.LEFT),
            Column("unit", align=Align.LEFT),
            Column("difference", form="+.3g"),
            Column("low", form="+.3g"),
            Column("high", form="+.3g"),
            Column("p", form=".3f"),
        ),
        tuple(
            (FIGURES[name].title, each.unit, each.difference, each.low, each.high, each.p_value)
            for name, each in comparison.differences.items()
        ),
    )


def _title(comparison: Comparison) -> str:
    return f"{Path(comparison.log).name} against {Path(comparison.baseline).name}"


def _bin_difference_table(what: str, bins: Sequence[BinDifference]) -> Table:
    return Table(
        f"Pairwise recall by {what}",
        (
            Column("stages", align=Align.LEFT),
            Column(what, align=Align.LEFT),
            Column("edges", form=","),
            Column("baseline", "%", ".1f"),
            Column("this", "%", ".1f"),
            Column("difference", "points", "+.1f"),
            Column("p", form=".3f"),
        ),
        tuple(
            (
                KIND_NAMES[kind], span(each.low, each.high), each.edges[kind], each.baseline[kind],
                each.value[kind], each.value[kind] - each.baseline[kind], each.p_value[kind],
            )
            for kind in KINDS[1:]
            for each in bins
            if each.edges[kind]
        ),
    )  # fmt: skip


def _changes_table(comparison: Comparison) -> Table:
    rows: list[Row] = [
        (name, len(changes.won), len(changes.lost), comparison.edges)
        for name, changes in (
            ("pairwise", comparison.pairwise),
            ("multi-way", comparison.multiway),
        )
        if changes is not None
    ]
    return Table(
        "Pairs won and lost",
        (
            Column("transforms", align=Align.LEFT),
            Column("won", form=","),
            Column("lost", form=","),
            Column("edges", form=","),
        ),
        tuple(rows),
        "Won: right here and wrong in the baseline. --json lists the pairs.",
    )
