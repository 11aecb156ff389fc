"""Variants side by side: recall, time, memory and calibration in one table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nss_ros.batch.variant import VariantResult
from nss_ros.benchmark.headline import Headline
from nss_ros.benchmark.score import LogScore
from nss_ros.benchmark.table import KIND_NAMES, bin_table
from nss_ros.table import Align, Cell, Column, Table

_KINDS = ("same_stage", "different_stage")


def variant_tables(results: Sequence[VariantResult]) -> list[Table]:
    """The table of all figures, then recall by overlap ratio and by temporal change ratio."""
    scores = [result.score for result in results]
    binned = [
        bin_table(scores, by)
        for by in ("overlap", "change")
        if any(_has_bins(score, by) for score in scores)
    ]
    return [variant_table(results), *binned]


def variant_table(results: Sequence[VariantResult]) -> Table:
    """One row per variant.

    Args:
        results: of the same pairs.
    """
    edges = results[0].score.overall.pairwise if results else None
    counts = (
        f": {edges.same_stage.edges:,} same-stage, {edges.different_stage.edges:,} "
        "different-stage pairs"
        if edges
        else ""
    )
    return Table(
        f"Registration methods{counts}",
        (
            Column("method", align=Align.LEFT),
            *(
                column
                for kind in _KINDS
                for column in (
                    Column(f"recall, {KIND_NAMES[kind]}", "%", ".1f"),
                    Column("interval", "%"),
                    Column("among hypotheses", "%", ".1f"),
                )
            ),
            Column("failed", form=","),
            Column("pair, features cached", "s", ".2f"),
            Column("not cached", "s", ".2f"),
            Column("memory", "MiB", ",.0f"),
            Column("ECE", form=".3f"),
            Column("overlap AUROC", form=".3f"),
        ),
        tuple(_row(result) for result in results),
        "Recall: RRE <= 10 deg and RTE <= 0.2 m, with bootstrap intervals. Among hypotheses: "
        "that of whoever picks the right one of each answer's hypotheses. ECE: expected "
        "calibration error of the confidence in ten bins, also of pairs that do not overlap. "
        "AUROC: of the overlap probability. Memory: most of a worker process, libraries included.",
    )


def _row(result: VariantResult) -> tuple[Cell, ...]:
    headline = result.score.headline
    cells: list[Cell] = [result.name]
    for kind in _KINDS:
        recall = headline.get(f"recall_{kind}")
        cells += [recall.value if recall else None, _interval(recall), _known(result.among[kind])]
    cells += [result.timing.failed, result.timing.register, result.timing.alone, result.memory]
    for name in ("confidence_error", "overlap_auroc"):
        cells.append(headline[name].value if name in headline else None)
    return tuple(cells)


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _interval(figure: Headline | None) -> str | None:
    if figure is None or not figure.low <= figure.high:  # NaN of one pair, or of none
        return None
    return f"{figure.low:.1f}-{figure.high:.1f}"


def _has_bins(score: LogScore, by: str) -> bool:
    return bool(score.overlap_bins if by == "overlap" else score.change_bins)
