"""The headline figures as groups that are read at a glance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nss_ros.benchmark.headline import FIGURES, Headline

_CARDS: tuple[tuple[str, str, tuple[tuple[str, str], ...]], ...] = (
    (
        "Pairwise recall",
        "Relative transforms within 10 deg and 0.2 m",
        (
            ("recall_all", "all"),
            ("recall_same_stage", "same stage"),
            ("recall_different_stage", "different stages"),
            ("recall_challenge_all", "all, at 0.1 m"),
        ),
    ),
    (
        "Recall of the map",
        "The same edges, from the poses of the map; between components they are missed",
        (
            ("multiway_recall_all", "all"),
            ("multiway_recall_same_stage", "same stage"),
            ("multiway_recall_different_stage", "different stages"),
            ("multiway_recall_challenge_all", "all, at 0.1 m"),
            ("multiway_recall_main", "main component alone"),
        ),
    ),
    (
        "The map",
        "Over all points of fragments in the main component",
        (
            ("global_rmse", "global RMSE"),
            ("official_global_rmse", "official RMSE"),
            ("coverage", "coverage"),
            ("outlier_f1", "outlier F1"),
        ),
    ),
    (
        "Errors of successes",
        "Mean over all edges that succeed",
        (
            ("rte_all", "pairwise RTE"),
            ("rre_all", "pairwise RRE"),
            ("multiway_rte_all", "map RTE"),
            ("multiway_rre_all", "map RRE"),
        ),
    ),
    (
        "Overlap and confidence",
        "Is the method right about itself?",
        (
            ("overlap_mean_average_precision", "overlap mAP"),
            ("overlap_auroc", "overlap AUROC"),
            ("map_overlap_auroc", "overlap AUROC, map"),
            ("confidence_auroc", "confidence AUROC"),
            ("confidence_error", "confidence ECE"),
        ),
    ),
)


@dataclass(frozen=True, slots=True)
class CardRow:
    """A figure.

    Attributes:
        name: as gates have it.
        label: short.
        value: with its unit.
        interval: low and high; empty without.
        bar: value, low and high on a scale of 0..100; None if it is no part of a whole.
    """

    name: str
    label: str
    value: str
    interval: str
    bar: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class Card:
    """Figures that belong together."""

    title: str
    text: str
    rows: tuple[CardRow, ...]


def cards(headline: Mapping[str, Headline]) -> list[Card]:
    """The groups for which there are figures."""
    result = []
    for title, text, names in _CARDS:
        rows = tuple(
            _row(name, label, headline[name])
            for name, label in names
            if name in headline and not np.isnan(headline[name].value)
        )
        if rows:
            result.append(Card(title, text, rows))
    return result


def _row(name: str, label: str, figure: Headline) -> CardRow:
    known = not np.isnan(figure.low)
    bar = None
    if FIGURES[name].is_share:
        scale = 1.0 if figure.unit == "%" else 100.0
        ends = (figure.low, figure.high) if known else (figure.value, figure.value)
        bar = (figure.value * scale, ends[0] * scale, ends[1] * scale)
    return CardRow(
        name,
        label,
        f"{_number(figure.value, figure.unit)}{' ' if figure.unit else ''}{figure.unit}",
        f"{_number(figure.low, figure.unit)} \N{EN DASH} {_number(figure.high, figure.unit)}"
        if known
        else "",
        bar,
    )


def _number(value: float, unit: str) -> str:
    if unit == "%":
        return f"{value:.1f}"
    return f"{value:.2f}" if unit == "deg" else f"{value:.3f}"
