"""Charts for plotly.js: one figure per panel, so that a page can set them side by side or not."""

from __future__ import annotations

from typing import Any

import numpy as np

from nss_ros.benchmark.chart import Axis, Mark, Panel, Series
from nss_ros.benchmark.metrics import Floats

_GRID = "#e8eaed"


def plotly_figure(panel: Panel) -> dict[str, Any]:
    """Data and layout of a panel, ready for JSON."""
    layout: dict[str, Any] = {
        "xaxis": _axis(panel.x),
        "yaxis": _axis(panel.y),
        "showlegend": False,
        "hovermode": "closest",
        "margin": {"l": 58, "r": 12, "t": 30 if panel.title else 12, "b": 46},
        "font": {"size": 12, "color": "#33373d"},
        "hoverlabel": {"align": "left"},
        "barmode": "overlay",
        "shapes": [_line_at(value) for value, _ in panel.marks],
        "annotations": [_text_at(panel.x, value, text) for value, text in panel.marks if text],
        "dragmode": "pan" if panel.equal else "zoom",
    }
    if panel.title:
        layout["title"] = {"text": panel.title, "font": {"size": 13}, "x": 0.5, "y": 0.98}
    if panel.equal:
        layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    return {"data": [_trace(series) for series in panel.series], "layout": layout}


def _axis(axis: Axis) -> dict[str, Any]:
    result: dict[str, Any] = {
        "title": {"text": axis.label, "font": {"size": 12}, "standoff": 6},
        "gridcolor": _GRID,
        "zeroline": False,
        "linecolor": "#888",
        "ticks": "outside",
        "ticklen": 4,
    }
    if axis.log:
        result |= {"type": "log", "dtick": 1, "tickformat": "~g"}
    if axis.low is not None and axis.high is not None:
        ends = np.array((axis.low, axis.high))
        result["range"] = (np.log10(ends) if axis.log else ends).tolist()
    elif axis.low == 0:
        result["rangemode"] = "tozero"
    return result


def _line_at(value: float) -> dict[str, Any]:
    return {
        "type": "line", "x0": value, "x1": value, "yref": "paper", "y0": 0, "y1": 1,
        "layer": "below", "line": {"color": "#888", "width": 1, "dash": "dot"},
    }  # fmt: skip


def _text_at(axis: Axis, value: float, text: str) -> dict[str, Any]:
    return {
        "x": float(np.log10(value)) if axis.log else value, "yref": "paper", "y": 0.02,
        "text": text, "showarrow": False, "xanchor": "left", "yanchor": "bottom",
        "font": {"size": 11, "color": "#666"},
    }  # fmt: skip


def _trace(series: Series) -> dict[str, Any]:
    trace: dict[str, Any] = {
        "x": _numbers(series.x),
        "y": _numbers(series.y),
        "name": series.name,
        "opacity": series.alpha,
    }
    if series.hover:
        trace |= {"text": list(series.hover), "hovertemplate": "%{text}<extra></extra>"}
    if series.links:
        trace["customdata"] = list(series.links)
    if series.mark is Mark.BARS:
        return trace | {
            "type": "bar", "textposition": "none", "width": series.width,
            "marker": {"color": series.colour},
        }  # fmt: skip
    parts = ["lines"] * series.mark.has_line + ["markers"] * series.mark.has_points
    trace |= {"type": "scatter", "mode": "+".join(parts)}
    if series.mark.has_line:
        dash = "6px,3px" if series.mark.dashed else "solid"
        trace["line"] = {"color": series.colour, "width": series.size, "dash": dash}
        if not series.hover and not series.mark.has_points and np.isnan(series.x).any():
            trace["hoverinfo"] = "skip"
    if series.mark.has_points:
        size = series.size if series.mark is Mark.POINTS else 6
        symbol = "circle-open" if series.hollow else "circle"
        trace["marker"] = {"color": series.colour, "size": size, "symbol": symbol}
    return trace


def _numbers(values: Floats) -> list[float | None]:
    """Short numbers; None, which breaks a line, for what is not finite."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
