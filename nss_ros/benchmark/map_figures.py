"""Pictures of a map: plan and section by stage, before and after the multi-way step, and its graph.

Stages are laid over each other like inks, so that no stage hides another.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.benchmark.chart import MAX_POINTS, Axis, Chart, Mark, Panel, Series, spread
from nss_ros.benchmark.map_view import MapView
from nss_ros.benchmark.metrics import MAX_RTE, Floats
from nss_ros.colors import stage_hex
from nss_ros.dataset.figures import STYLE
from nss_ros.fragment import FragmentPair, Points
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus, PoseGraph

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ACCEPTED, REJECTED = "#4d4d4d", "#B2182B"
"""Colours of edges."""

_DPI = 120  # of pictures
_SPOT = 0.07  # metres: a point covers what lies so near
SECTION_DEPTH = 0.6
"""What lies so near to the plane of a section is in it, metres."""
_MOST_PIXELS = 3  # that a point is wide
_MARGIN = 0.4  # metres
_FAINT, _FULL = 0.22, 0.88  # opacity of the palest and of the darkest ink
_DARKEST = 88  # percentile of points per occupied pixel that is drawn darkest
_WIDTH = 9.2  # inches
_MOST_COLUMNS = 3

Inks = Mapping[str, Points]
"""Points by colour."""


def map_figure(view: MapView) -> Figure:
    """All stages over each other, in plan and below it in section.

    Args:
        view: with points.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    inks = {stage_hex(stage): points for stage, points in view.points.items()}
    low, high = limits(view.points.values())
    with mpl.rc_context(STYLE):
        size = (_WIDTH, _WIDTH * 0.9 * _ratio(low, high) + 1.0)
        figure = Figure(figsize=size, layout="compressed")
        plan, section = figure.subplots(2, 1, sharex=True, height_ratios=_heights(low, high))
        _draw_view(plan, section, view, inks, low, high)
        plan.set(ylabel="y (m)", title="Plan")
        section.set(xlabel="x (m)", ylabel="z (m)", title="Section at the dotted line")
        figure.legend(
            handles=stage_handles(view.stages), loc="outside lower center", frameon=False, ncols=6
        )
    return figure


def stage_figure(view: MapView) -> Figure:
    """Each stage by itself, in plan and below it in section.

    Args:
        view: with points.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    stages = list(view.points)
    columns = min(len(stages), _MOST_COLUMNS)
    rows = -(-len(stages) // columns)
    low, high = limits(view.points.values())
    each = _WIDTH / columns
    with mpl.rc_context(STYLE):
        size = (_WIDTH, rows * (each * 0.9 * _ratio(low, high) + 0.75))
        figure = Figure(figsize=size, layout="compressed")
        grid = figure.subplots(
            2 * rows, columns, squeeze=False, sharex=True,
            height_ratios=_heights(low, high) * rows,
        )  # fmt: skip
        for number in range(columns * rows):
            plan = grid[2 * (number // columns), number % columns]
            section = grid[2 * (number // columns) + 1, number % columns]
            if number >= len(stages):
                plan.remove()
                section.remove()
                continue
            stage = stages[number]
            inks = {stage_hex(stage): view.points[stage]}
            _draw_view(plan, section, view, inks, low, high)
            plan.set_title(f"Stage {stage}")
            if number % columns == 0:
                plan.set_ylabel("y (m)")
                section.set_ylabel("z (m)")
            else:
                plan.tick_params(labelleft=False)
                section.tick_params(labelleft=False)
            if number + columns >= len(stages):
                section.set_xlabel("x (m)")
    return figure


def before_after_figure(before: MapView, after: MapView) -> Figure:
    """The map before and after the multi-way step, in plan and section.

    Args:
        before: of `chained_view`.
        after: the map.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    low, high = limits([*before.points.values(), *after.points.values()])
    with mpl.rc_context(STYLE):
        size = (_WIDTH, _WIDTH / 2 * 0.9 * _ratio(low, high) + 1.2)
        figure = Figure(figsize=size, layout="compressed")
        grid = figure.subplots(2, 2, sharex=True, height_ratios=_heights(low, high))
        for column, (view, name) in enumerate(((before, "Before"), (after, "After"))):
            inks = {stage_hex(s): points for s, points in view.points.items()}
            plan, section = grid[:, column]
            _draw_view(plan, section, view, inks, low, high)
            plan.set_title(f"{name}{_off(view)}")
            section.set_xlabel("x (m)")
            if column:
                plan.tick_params(labelleft=False)
                section.tick_params(labelleft=False)
        grid[0, 0].set_ylabel("y (m)")
        grid[1, 0].set_ylabel("z (m)")
        figure.legend(
            handles=stage_handles(after.stages), loc="outside lower center", frameon=False, ncols=6
        )
    return figure


def _off(view: MapView) -> str:
    """How far the spots of a view are from their true places, as part of a title."""
    gaps = view.gaps
    if not len(gaps):
        return ""
    near = int((gaps <= MAX_RTE).sum())
    return f": {near} of {len(gaps)} spots within {MAX_RTE:g} m, median off {np.median(gaps):.2f} m"


def graph_chart(graph: PoseGraph, view: MapView, links: Mapping[FragmentPair, str]) -> Chart:
    """The graph over space and time in plan: nodes by stage, edges accepted or rejected.

    Args:
        graph: the map's.
        view: where its fragments stand.
        links: an id in the report of each pair, to which its edge leads.
    """
    series = []
    for status, name, colour, width, opacity in (
        (EdgeStatus.REJECTED, "edge rejected", REJECTED, 1.0, 0.45),
        (EdgeStatus.ACCEPTED, "edge accepted", ACCEPTED, 1.1, 0.75),
    ):
        edges = [
            edge
            for edge in graph.edges
            if edge.status is status and {edge.pair.source, edge.pair.target} <= view.spots.keys()
        ]
        if not edges:
            continue
        label = f"{name} ({len(edges):,})"
        if len(edges) > MAX_POINTS:
            label = f"{name} ({MAX_POINTS:,} of {len(edges):,})"
            edges = [edges[i] for i in spread(len(edges), MAX_POINTS)]
        # Many lines lie over each other.
        alpha = opacity * float(np.clip(400 / len(edges), 0.25, 1))
        ends = np.array([[view.spots[e.pair.source], view.spots[e.pair.target]] for e in edges])
        gaps = np.full((len(edges), 1), np.nan)
        x, y = (np.hstack((ends[:, :, axis], gaps)).ravel() for axis in (0, 1))
        series.append(Series(label, x, y, colour, size=width, alpha=alpha))
        middle = ends.mean(axis=1)
        # Lines cannot be pointed at: their middles can.
        series.append(
            Series(
                "",
                middle[:, 0],
                middle[:, 1],
                colour,
                Mark.POINTS,
                tuple(_edge_text(edge.pair, name, _why(edge)) for edge in edges),
                tuple(links.get(edge.pair, "") for edge in edges),
                size=3,
                alpha=alpha,
            )
        )
    if doubtful := [id_ for id_ in graph.doubtful() if id_ in view.spots]:
        places = np.array([view.spots[id_] for id_ in doubtful])
        name = f"place doubtful ({len(doubtful):,})"
        # Around the spots, which are drawn over it.
        series.append(
            Series(name, places[:, 0], places[:, 1], REJECTED, Mark.POINTS, size=14, hollow=True)
        )
    series += [_spots(view, stage) for stage in view.stages]
    panel = Panel(Axis("x (m)"), Axis("y (m)"), tuple(series), equal=True)
    return Chart(
        f"Spatiotemporal graph of {view.name}, in plan",
        (panel,),
        "Where each fragment was taken from, and which relative transforms the map kept. Failed "
        "registrations are not drawn.",
    )


def _why(edge: Edge) -> str:
    return "found by submaps" if edge.kind is EdgeKind.SUBMAP else edge.reason


def _spots(view: MapView, stage: int) -> Series:
    spots = {id_: spot for id_, spot in view.spots.items() if id_.stage == stage}
    places = np.array(list(spots.values()))
    return Series(
        f"stage {stage} ({len(spots):,})",
        places[:, 0],
        places[:, 1],
        stage_hex(stage),
        Mark.POINTS,
        tuple(map(str, spots)),
        size=8,
    )


def _edge_text(pair: FragmentPair, name: str, reason: str) -> str:
    text = f"{name}<br>{pair.source}<br>→ {pair.target}"
    return f"{text}<br>{reason}" if reason else text


def stage_handles(stages: Sequence[int]) -> list[Any]:
    """Entries of a legend."""
    from matplotlib.patches import Patch

    return [Patch(color=stage_hex(s), label=f"stage {s}") for s in stages]


def limits(clouds: Iterable[Points]) -> tuple[Floats, Floats]:
    """Lower and upper corner around clouds, without stray points, metres."""
    some = np.concatenate([cloud[:: max(1, len(cloud) // 100_000)] for cloud in clouds])
    low, high = np.percentile(some, (0.1, 99.9), axis=0)
    return low - _MARGIN, high + _MARGIN


def draw_plan(
    axes: Axes, inks: Inks, low: Floats, high: Floats, heights: tuple[float, float]
) -> None:
    """Points between two heights, seen from above."""
    cut = {
        colour: points[(points[:, 2] > heights[0]) & (points[:, 2] < heights[1])]
        for colour, points in inks.items()
    }
    _draw(axes, cut, low, high, (0, 1))


def draw_section(
    axes: Axes, inks: Inks, low: Floats, high: Floats, middle: float | None = None
) -> None:
    """Points seen along y: those near a plane y = `middle`, or all."""
    near = {
        colour: points if middle is None else points[np.abs(points[:, 1] - middle) < SECTION_DEPTH]
        for colour, points in inks.items()
    }
    _draw(axes, near, low, high, (0, 2))


def _draw_view(
    plan: Axes, section: Axes, view: MapView, inks: Inks, low: Floats, high: Floats
) -> None:
    """Plan and section of some of a view's stages, the plane of the section dotted in the plan."""
    middle = view.middle()
    draw_plan(plan, inks, low, high, view.slice())
    draw_section(section, inks, low, high, middle)
    plan.axhline(middle, color="#444444", linewidth=0.9, linestyle=(0, (1, 3)))


def _draw(axes: Axes, inks: Inks, low: Floats, high: Floats, plane: tuple[int, int]) -> None:
    across, up = plane
    extent = (low[across], high[across], low[up], high[up])
    figure = axes.get_figure(root=True)
    grid = axes.get_gridspec()
    width = figure.get_figwidth() if figure is not None else _WIDTH
    pixels = round(_DPI * width / (grid.ncols if grid is not None else 1))
    image = ink_picture(
        {colour: points[:, plane] for colour, points in inks.items()}, extent, pixels
    )
    axes.imshow(image, extent=extent, origin="lower", interpolation="antialiased")
    axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
    axes.locator_params(axis="y", nbins=7 if up == 1 else 3)


def ink_picture(
    inks: Mapping[str, NDArray[np.floating]],
    extent: tuple[float, float, float, float],
    pixels: int,
) -> NDArray[np.float64]:
    """Points (n, 2) by colour printed over each other on white, (h, w, 3) 0..1, first row lowest.

    Args:
        inks: points by colour, metres.
        extent: left, right, bottom and top, metres.
        pixels: across.
    """
    from matplotlib.colors import to_rgb
    from scipy.ndimage import maximum_filter

    left, right, bottom, top = extent
    shape = (max(1, round(pixels * (top - bottom) / (right - left))), pixels)
    image = np.ones((*shape, 3))
    size = int(np.clip(round(_SPOT * pixels / (right - left)), 1, _MOST_PIXELS))
    for colour, points in inks.items():
        counts, _, _ = np.histogram2d(
            points[:, 1], points[:, 0], shape, ((bottom, top), (left, right))
        )
        occupied = counts[counts > 0]
        if not len(occupied):
            continue
        dark = max(1.0, float(np.percentile(occupied, _DARKEST)))
        covered = maximum_filter(counts, size)
        strength = _FAINT + (_FULL - _FAINT) * np.sqrt(np.clip(covered / dark, 0, 1))
        strength[covered == 0] = 0
        image *= 1 - strength[..., None] * (1 - np.array(to_rgb(colour)))
    return image


def _heights(low: Floats, high: Floats) -> list[float]:
    return [float(high[1] - low[1]), float(max(high[2] - low[2], 0.08 * (high[1] - low[1])))]


def _ratio(low: Floats, high: Floats) -> float:
    """Height of plan and section together over their width."""
    return float(np.clip(sum(_heights(low, high)) / (high[0] - low[0]), 0.3, 2.2))
