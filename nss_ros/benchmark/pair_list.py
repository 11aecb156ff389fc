"""The pairs of a run as a table and as a chart, in which failures are looked up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from nss_ros.benchmark.chart import MAX_POINTS, Axis, Chart, Mark, Panel, Series, spread
from nss_ros.benchmark.pair_records import Outcome, PairRecord
from nss_ros.fragment import FragmentPair
from nss_ros.table import Align, Column, Table

_OUTCOME_COLOURS = {
    Outcome.WRONG: "#D55E00",
    Outcome.FAILED: "#E69F00",
    Outcome.UNANSWERED: "#999999",
    Outcome.UNKNOWN: "#56B4E9",
    Outcome.RIGHT: "#0072B2",
}


def pair_table(records: Sequence[PairRecord], total: int, scored: bool) -> Table:
    """Pairs as a table.

    Args:
        records: the rows.
        total: number of pairs of the run, of which these may be the worst.
        scored: there is ground truth.
    """
    errors = (
        Column("OR", form=".2f"),
        Column("TCR", form=".2f"),
        Column("RRE", "deg", ".2f"),
        Column("RTE", "m", ".3f"),
        Column("map RRE", "deg", ".2f"),
        Column("map RTE", "m", ".3f"),
    )
    rows = []
    for record in records:
        values = (
            (
                record.overlap_ratio, record.temporal_change, record.rre, record.rte,
                record.map_rre, record.map_rte,
            )
            if scored
            else ()
        )  # fmt: skip
        rows.append(
            (
                str(record.pair.source), str(record.pair.target), record.stages,
                record.outcome.word, *values, record.confidence, record.in_map or None,
                record.reason,
            )
        )  # fmt: skip
    shown = f" The first {len(records):,} of {total:,} pairs." if len(records) < total else ""
    caption = (
        "Worst first: wrong answers by their error, then failures, then pairs without an answer. "
        "Right: RRE <= 10 deg and RTE <= 0.2 m. OR: overlap ratio, TCR: temporal change ratio."
        if scored
        else "In the order of failures, pairs without an answer, and answers."
    )
    return Table(
        "Pairs",
        (
            Column("source", align=Align.LEFT),
            Column("target", align=Align.LEFT),
            Column("stages", align=Align.LEFT),
            Column("outcome", align=Align.LEFT),
            *(errors if scored else ()),
            Column("confidence", form=".2f"),
            Column("in the map", align=Align.LEFT),
            Column("reason", align=Align.LEFT),
        ),
        tuple(rows),
        caption + shown,
    )


def pair_chart(records: Sequence[PairRecord], links: Mapping[FragmentPair, str]) -> Chart | None:
    """Pairs over overlap and temporal change, by what became of them; None without these ratios.

    Args:
        records: of a run.
        links: an id in the report of each pair, to which its point leads.
    """
    series = []
    for outcome in reversed(Outcome):
        known = [
            record
            for record in records
            if record.outcome is outcome
            and np.isfinite(record.overlap_ratio)
            and np.isfinite(record.temporal_change)
        ]
        if not known:
            continue
        name = f"{outcome.word} ({len(known):,})"
        known = [known[i] for i in spread(len(known), MAX_POINTS)]
        series.append(
            Series(
                name,
                np.array([record.overlap_ratio for record in known]),
                np.array([record.temporal_change for record in known]),
                _OUTCOME_COLOURS[outcome],
                Mark.POINTS,
                tuple(_text(record) for record in known),
                tuple(links.get(record.pair, "") for record in known),
                size=7,
                alpha=0.8,
                hollow=outcome in (Outcome.FAILED, Outcome.UNANSWERED),
            )
        )
    if not series:
        return None
    panel = Panel(
        Axis("overlap ratio", 0.0, 1.0), Axis("temporal change ratio", 0.0), tuple(series)
    )
    return Chart(
        "Pairs by overlap and change",
        (panel,),
        "Answers of the registration. In the browser, a click on a point leads to its row.",
    )


def _text(record: PairRecord) -> str:
    lines = [f"{record.pair.source}", f"→ {record.pair.target}", record.outcome.word]
    if np.isfinite(record.rte):
        lines[-1] += f": off by {record.rte:.2f} m, {record.rre:.1f} deg"
    if record.reason:
        lines.append(record.reason)
    return "<br>".join(map(escape, lines))
