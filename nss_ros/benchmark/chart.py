"""A chart as data: drawn with matplotlib for files, and by plotly in the report."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from nss_ros.benchmark.metrics import Floats

MAX_POINTS = 1200
"""Of a series; more neither print nor fit into a report."""


class Mark(StrEnum):
    """How a series is drawn."""

    LINE = "line"
    DASHED = "dashed"
    LINE_POINTS = "line_points"
    DASHED_POINTS = "dashed_points"
    POINTS = "points"
    BARS = "bars"

    @property
    def dashed(self) -> bool:
        """Whether its line is dashed."""
        return self in (Mark.DASHED, Mark.DASHED_POINTS)

    @property
    def has_line(self) -> bool:
        """Whether its points are joined."""
        return self not in (Mark.POINTS, Mark.BARS)

    @property
    def has_points(self) -> bool:
        """Whether its points are marked."""
        return self in (Mark.POINTS, Mark.LINE_POINTS, Mark.DASHED_POINTS)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One curve, cloud of points or row of bars.

    Attributes:
        name: in the legend; series of one name share an entry, an empty one has none.
        x: (n,); NaN breaks a line.
        y: (n,).
        colour: `#rrggbb`.
        mark: how it is drawn.
        hover: a text per point, for the interactive chart; empty for the numbers alone.
        links: an id in the report per point, to which a click leads; empty for none.
        size: of points, or width of lines, pixels.
        alpha: opacity, 0..1.
        width: of bars, in units of x.
        hollow: points are rings.
    """

    name: str
    x: Floats
    y: Floats
    colour: str
    mark: Mark = Mark.LINE
    hover: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    size: float = 2.0
    alpha: float = 1.0
    width: float = 1.0
    hollow: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis.

    Attributes:
        label: with the unit in parentheses.
        low: lower end; None: as the data need.
        high: upper end; None: as the data need.
        log: logarithmic.
    """

    label: str
    low: float | None = None
    high: float | None = None
    log: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """A pair of axes with series.

    Attributes:
        x: horizontal axis.
        y: vertical axis.
        series: from back to front.
        title: may be empty.
        marks: values of x that are marked by a line, with their texts.
        equal: metres are as long on both axes.
        height: relative to the other panels of the chart.
    """

    x: Axis
    y: Axis
    series: tuple[Series, ...]
    title: str = ""
    marks: tuple[tuple[float, str], ...] = ()
    equal: bool = False
    height: float = 1.0


@dataclass(frozen=True, slots=True)
class Chart:
    """Panels that belong together.

    Attributes:
        title: what they show.
        panels: row by row.
        caption: how they are to be read; may be empty.
        columns: of the grid of panels, where there is room.
    """

    title: str
    panels: tuple[Panel, ...]
    caption: str = ""
    columns: int = 1

    def legend(self) -> tuple[Series, ...]:
        """One series for each name, in the order of appearance."""
        named: dict[str, Series] = {}
        for panel in self.panels:
            for series in panel.series:
                if series.name:
                    named.setdefault(series.name, series)
        return tuple(named.values())


def distribution(values: Floats, total: int | None = None) -> tuple[Floats, Floats]:
    """The cumulative distribution of values: their order, and percent of all up to each.

    Args:
        values: (n,) finite.
        total: what counts as 100 %; None: n.
    """
    ordered = np.sort(values)
    percent = 100 * np.arange(1, len(ordered) + 1) / max(total or len(ordered), 1)
    chosen = spread(len(ordered))
    return ordered[chosen], percent[chosen]


def spread(count: int, most: int = 400) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """At most so many numbers of 0..count-1, evenly spaced, first and last included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))
