"""Charts drawn with matplotlib, in the style of the other figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nss_ros.benchmark.chart import Axis, Chart, Mark, Panel, Series
from nss_ros.dataset.figures import STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL = 3.6, 3.0  # inches
_WIDE = 8.6
_DASH = (0, (4, 2))


def draw(chart: Chart, titled: bool = True) -> Figure:
    """The chart as a figure of matplotlib.

    Args:
        chart: what is drawn.
        titled: its title stands above it.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    columns = min(chart.columns, len(chart.panels))
    rows = -(-len(chart.panels) // columns)
    heights = [max(p.height for p in chart.panels[r * columns : (r + 1) * columns])
               for r in range(rows)]  # fmt: skip
    width = max(_WIDE, _PANEL[0] * columns)
    size = (width, sum(_height(chart, each, width / columns) for each in heights) + 0.8)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        if titled:
            figure.suptitle(chart.title)
        grid = figure.subplots(rows, columns, squeeze=False, height_ratios=heights)
        for axes in grid.flat[len(chart.panels) :]:
            axes.remove()
        for axes, panel in zip(grid.flat, chart.panels, strict=False):
            _draw_panel(axes, panel)
        legend = chart.legend()
        if len(legend) > 1:
            figure.legend(
                handles=[_handle(series) for series in legend],
                loc="outside lower center",
                ncols=min(len(legend), 4),
                frameon=False,
            )
    return figure


def _height(chart: Chart, relative: float, width: float) -> float:
    """Of a row, inches."""
    if not any(panel.equal for panel in chart.panels):
        return _PANEL[1] * relative
    extents = []
    for panel in chart.panels:
        x, y = (np.concatenate([getattr(s, axis) for s in panel.series]) for axis in "xy")
        spans = [np.ptp(v[np.isfinite(v)]) if np.isfinite(v).any() else 1.0 for v in (x, y)]
        extents.append((spans[1] + 1) / (spans[0] + 1))
    return float(np.clip((width - 1) * max(extents), 2.0, 8.0))


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for series in panel.series:
        _draw_series(axes, series)
    if panel.title:
        axes.set_title(panel.title)
    _set_axis(axes, "x", panel.x)
    _set_axis(axes, "y", panel.y)
    for value, text in panel.marks:
        axes.axvline(value, color="#888888", linewidth=0.9, linestyle=":", zorder=0)
        axes.annotate(
            text,
            (value, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, 3),
            textcoords="offset points",
            va="bottom",
            fontsize=8,
            color="#666666",
        )
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.grid(color="#e6e6e6", linewidth=0.7)
        axes.set_axisbelow(True)


def _set_axis(axes: Axes, name: str, axis: Axis) -> None:
    settings: dict[str, Any] = {f"{name}label": axis.label}
    if axis.log:
        settings[f"{name}scale"] = "log"
    axes.set(**settings)
    limits = {("left" if name == "x" else "bottom"): axis.low,
              ("right" if name == "x" else "top"): axis.high}  # fmt: skip
    known: Any = {end: value for end, value in limits.items() if value is not None}
    if known:
        (axes.set_xlim if name == "x" else axes.set_ylim)(**known)
    if axis.log:
        # 0.1 rather than a power of ten
        getattr(axes, f"{name}axis").set_major_formatter(lambda value, _: f"{value:g}")


def _draw_series(axes: Axes, series: Series) -> None:
    if series.mark is Mark.BARS:
        axes.bar(series.x, series.y, series.width, color=series.colour, alpha=series.alpha)
    elif series.mark is Mark.POINTS:
        axes.scatter(
            series.x,
            series.y,
            s=series.size**2,
            facecolors="none" if series.hollow else series.colour,
            edgecolors=series.colour if series.hollow else "none",
            alpha=series.alpha,
            linewidths=1.0,
            zorder=3,
        )
    else:
        axes.plot(series.x, series.y, zorder=2, **_line(series))


def _line(series: Series) -> dict[str, Any]:
    return {
        "color": series.colour,
        "linewidth": series.size * 0.75,
        "linestyle": _DASH if series.mark.dashed else "-",
        "marker": "o" if series.mark.has_points else None,
        "markersize": 4,
        "alpha": series.alpha,
    }


def _handle(series: Series) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if series.mark is Mark.BARS:
        return Patch(color=series.colour, alpha=series.alpha, label=series.name)
    if series.mark is Mark.POINTS:
        return Line2D(
            [], [], color=series.colour, marker="o", linestyle="none", markersize=5,
            fillstyle="none" if series.hollow else "full", label=series.name,
        )  # fmt: skip
    return Line2D([], [], label=series.name, **_line(series) | {"alpha": 1.0})
