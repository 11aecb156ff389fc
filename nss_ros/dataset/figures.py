"""Plots of a dataset: how hard its pairs are, where its spots lie, how its graphs hang together.

After the figures of the NSS paper's dataset section (Sun et al. 2023, arXiv 2311.09346): the
joint distribution of overlap and temporal change for all pairs and for those selected, and the
spatiotemporal graph. Drawn without a display and without the state of pyplot.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.colors import stage_hex
from nss_ros.errors import InputError
from nss_ros.files import write_file
from nss_ros.fragment import FragmentId
from nss_ros.multiway.pose_graph import EdgeKind, PoseGraph

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from nss_ros.dataset.pairs import PairTable

Array = NDArray[np.float64]

_SAME, _DIFFERENT = "#0072B2", "#D55E00"

_BINS = 20
_CELL_SHARES = 0.01, 30.0  # percent: one scale for every dataset
_MARGIN = 2.0  # around the spots, metres
_SKEW, _FORESHORTENING = 0.35, 0.45
STYLE: Any = {  # settings of matplotlib for all figures
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "svg.hashsalt": "nss",  # else the ids in an SVG differ from run to run
    "svg.fonttype": "none",
}


def pair_figure(pairs: PairTable, selected: bool) -> Figure:
    """Joint distributions of overlap with temporal change and with complexity.

    Same-stage pairs on the left, different-stage pairs on the right; the distribution of each
    axis alone is drawn at the panels' edges. The scales are those of all pairs, so that the
    figures of all and of selected pairs compare.

    Args:
        pairs: of a dataset.
        selected: only the selected pairs, else all.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    shown = pairs.selected if selected else np.ones(len(pairs), dtype=bool)
    complexity = pairs.complexity
    axes = (
        _Axis("overlap ratio", pairs.overlap_ratio, 1.0),
        _Axis("temporal change ratio", pairs.temporal_change, 1.0),
        _Axis("surface variation", complexity, _ceiling(complexity)),
    )
    same = pairs.same_stage
    sides = (same, ~same)
    masks = [side & some for side in sides for some in (pairs.selected, True)]
    most = max(float(axis.shares(mask).max()) for axis in axes for mask in masks)
    most = 10 * float(np.ceil(max(most, 1) / 10))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.2, 8.0), layout="constrained")
        figure.suptitle(f"{'Selected' if selected else 'All'} pairs ({shown.sum():,})")
        halves = figure.subfigures(1, 2, squeeze=False)[0]
        for half, side, name, colour in (
            (halves[0], sides[0], "Same stage", _SAME),
            (halves[1], sides[1], "Different stages", _DIFFERENT),
        ):
            mask = shown & side
            half.suptitle(f"{name} ({mask.sum():,})", color=colour, fontsize=11)
            _distributions(half, axes, mask, most, colour)
    return figure


def plan_figure(graph: PoseGraph) -> Figure:
    """The spots of a graph in plan, one panel per stage, with the edges within the stage.

    Args:
        graph: with true poses, of one area; nodes without a pose are counted only.

    Raises:
        InputError: no node has a pose.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    stages = _stages(graph)
    columns = len(stages) if len(stages) <= 3 else -(-len(stages) // 2)
    rows = -(-len(stages) // columns)
    low, high = _limits(graph)
    height = 9.4 / columns * (high[1] - low[1]) / (high[0] - low[0])
    with mpl.rc_context(STYLE):
        size = (10.6, rows * (float(np.clip(height, 1.2, 8.0)) + 0.45) + 0.8)
        figure = Figure(figsize=size, layout="constrained")
        figure.suptitle(_graph_title(graph))
        figure.supxlabel("x (m)", fontsize=10)
        figure.supylabel("y (m)", fontsize=10)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in panels.flat[len(stages) :]:
            axes.remove()
        for number, stage in enumerate(stages):
            axes = panels.flat[number]
            lines = _draw_stage(axes, graph, stage, stage_hex(stage))
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axes.tick_params(labelbottom=number + columns >= len(stages))
            axes.locator_params(nbins=7, steps=(1, 2, 5, 10))
        figure.colorbar(lines, ax=figure.axes, label="overlap ratio of the edge", aspect=30)
    return figure


def spatiotemporal_figure(graph: PoseGraph) -> Figure:
    """A graph over space and time: stages as levels above each other, edges within and between.

    Args:
        graph: with true poses, of one area; nodes without a pose are counted only.

    Raises:
        InputError: no node has a pose.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    stages = _stages(graph)
    low, high = _limits(graph)
    lift = 1.02 * _FORESHORTENING * (high[1] - low[1])
    places = {
        id_: _oblique(node.T_map_fragment[:2, 3], lift * stages.index(id_.stage))
        for id_, node in graph.poses().items()
    }
    outline = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    width, depth = np.ptp(_oblique(outline, 0.0), axis=0)
    aspect = (depth + lift * (len(stages) - 1)) / width
    with mpl.rc_context(STYLE):
        size = (9.0, float(np.clip(6.4 * aspect, 3.0, 9.0)) + 0.5)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.add_subplot(frameon=False)
        _draw_levels(axes, stages, outline, lift)
        for stage in stages:
            here = np.array([place for id_, place in places.items() if id_.stage == stage])
            _draw_spots(axes, here, stage_hex(stage), f"stage {stage}")
        _draw_edges(axes, graph, places, EdgeKind.SAME_STAGE, "within a stage")
        _draw_edges(axes, graph, places, EdgeKind.DIFFERENT_STAGE, "between stages")
        axes.set(aspect="equal", xticks=[], yticks=[])
        axes.set_title(_graph_title(graph))
        handles, labels = axes.get_legend_handles_labels()
        by_height = [*range(len(stages) - 1, -1, -1), *range(len(stages), len(labels))]
        figure.legend(
            [handles[i] for i in by_height],
            [labels[i] for i in by_height],
            frameon=False,
            loc="outside right center",
        )
    return figure


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG, SVG or PDF, as the file's ending says; the same bytes every time.

    Raises:
        InputError: the ending is none of these.
        FormatError: the file cannot be written.
    """
    import matplotlib as mpl

    ending = path.suffix.lower()
    undated: dict[str, dict[str, Any]] = {
        ".png": {},
        ".svg": {"Date": None},
        ".pdf": {"CreationDate": None},
    }
    if ending not in undated:
        raise InputError(f"{path} cannot be a figure: its name must end with .png, .svg or .pdf.")
    stream = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(stream, format=ending[1:], metadata=undated[ending])
    write_file(path, stream.getvalue())


@dataclass(frozen=True, slots=True)
class _Axis:
    """A quantity of all pairs, and the end of its scale."""

    name: str
    values: Array
    end: float

    @property
    def edges(self) -> Array:
        return np.linspace(0.0, self.end, _BINS + 1)

    def shares(self, mask: NDArray[np.bool_]) -> Array:
        """Percent of the masked pairs per bin."""
        counts, _ = np.histogram(self.values[mask], self.edges)
        return np.asarray(100 * counts / max(mask.sum(), 1))


def _distributions(
    figure: SubFigure, axes: tuple[_Axis, ...], mask: NDArray[np.bool_], most: float, colour: str
) -> None:
    """Panels of the first axis against each of the others, and the distribution of each axis."""
    x, *others = axes
    grid = figure.subplots(
        1 + len(others),
        2,
        sharex="col",
        gridspec_kw={"width_ratios": (4, 1), "height_ratios": (1, *len(others) * (3,))},
    )
    grid[0, 1].remove()
    grid[0, 0].stairs(x.shares(mask), x.edges, fill=True, color=colour, alpha=0.75)
    grid[0, 0].set(ylabel="pairs (%)", ylim=(0, most))
    for (panel, side), y in zip(grid[1:], others, strict=True):
        mesh = _joint(panel, x, y, mask)
        panel.set(xlim=(0, x.end), ylim=(0, y.end), ylabel=y.name)
        side.stairs(
            y.shares(mask), y.edges, orientation="horizontal", fill=True, color=colour, alpha=0.75
        )
        side.set(ylim=(0, y.end), yticklabels=[], xlim=(0, most))
    panel.set_xlabel(x.name)
    side.set_xlabel("pairs (%)")
    figure.colorbar(
        mesh, ax=grid[1:], location="bottom", label="pairs per cell (%)", aspect=40, pad=0.02
    )


def _joint(axes: Axes, x: _Axis, y: _Axis, mask: NDArray[np.bool_]) -> Any:
    from matplotlib.colors import LogNorm

    counts, _, _ = np.histogram2d(x.values[mask], y.values[mask], (x.edges, y.edges))
    share = 100 * counts.T / max(mask.sum(), 1)
    return axes.pcolormesh(
        x.edges,
        y.edges,
        np.ma.masked_equal(share, 0),
        norm=LogNorm(_CELL_SHARES[0], _CELL_SHARES[1], clip=True),
        cmap="viridis",
        rasterized=True,
    )


def _ceiling(values: Array) -> float:
    """A round number just above the largest value, the end of an axis."""
    largest = float(np.nanmax(values, initial=0.0))
    return float(np.ceil(largest / 0.02) * 0.02) or 0.02


def _draw_stage(axes: Axes, graph: PoseGraph, stage: int, colour: str) -> Any:
    from matplotlib.collections import LineCollection

    places = {
        id_: node.T_map_fragment[:2, 3] for id_, node in graph.poses().items() if id_.stage == stage
    }
    edges = [edge for edge in graph.edges if {edge.pair.source, edge.pair.target} <= places.keys()]
    lines = LineCollection(
        [(places[edge.pair.source], places[edge.pair.target]) for edge in edges],
        array=np.array([edge.overlap_ratio for edge in edges]),
        cmap="viridis_r",
        linewidths=1.1,
        zorder=1,
    )
    lines.set_clim(0.0, 1.0)
    axes.add_collection(lines)
    _draw_spots(axes, np.array(list(places.values())), colour)
    axes.set_title(f"Stage {stage}: {len(places)} spots, {len(edges)} edges")
    return lines


def _draw_spots(axes: Axes, places: Array, colour: str, label: str | None = None) -> None:
    x, y = places.T
    axes.scatter(
        x, y, s=26, color=colour, edgecolors="white", linewidths=0.6, zorder=3, label=label
    )


def _draw_levels(axes: Axes, stages: list[int], outline: Array, lift: float) -> None:
    for number, stage in enumerate(stages):
        x, y = _oblique(outline, lift * number).T
        axes.fill(x, y, facecolor=stage_hex(stage), alpha=0.07, zorder=0)
        axes.plot(x, y, color=stage_hex(stage), linewidth=0.8, alpha=0.6, zorder=0)


def _draw_edges(
    axes: Axes, graph: PoseGraph, places: dict[FragmentId, Array], kind: EdgeKind, where: str
) -> None:
    from matplotlib.collections import LineCollection

    lines = [
        (places[edge.pair.source], places[edge.pair.target])
        for edge in graph.edges
        if edge.kind is kind and {edge.pair.source, edge.pair.target} <= places.keys()
    ]
    same = kind is EdgeKind.SAME_STAGE
    colour, width, alpha = ("#333333", 0.8, 0.7) if same else (_DIFFERENT, 0.5, 0.7)
    if not same:  # many lines lie over each other
        alpha = float(np.clip(60 / max(len(lines), 1), 0.1, alpha))
    axes.add_collection(
        LineCollection(lines, colors=colour, linewidths=width, alpha=alpha, zorder=2 if same else 1)
    )
    axes.plot([], [], color=colour, label=f"edge {where} ({len(lines):,})")


def _stages(graph: PoseGraph) -> list[int]:
    """Stages with a placed node.

    Raises:
        InputError: there is none.
    """
    stages = sorted({id_.stage for id_ in graph.poses()})
    if not stages:
        raise InputError(f"Graph '{graph.name}' has no node with a pose to draw.")
    return stages


def _limits(graph: PoseGraph) -> tuple[Array, Array]:
    """Lower left and upper right around all spots, metres."""
    spots = np.array([node.T_map_fragment[:2, 3] for node in graph.poses().values()])
    return spots.min(axis=0) - _MARGIN, spots.max(axis=0) + _MARGIN


def _oblique(places: Array, height: float) -> Array:
    """Places (..., 2) on a level of some height, drawn in cabinet projection."""
    x, y = places[..., 0], places[..., 1]
    return np.stack((x + _SKEW * y, _FORESHORTENING * y + height), axis=-1)


def _graph_title(graph: PoseGraph) -> str:
    outside = len(graph.nodes) - len(graph.poses())
    title = f"{graph.name}: {len(graph.nodes)} nodes, {len(graph.edges):,} edges"
    return f"{title}, {outside} not placed" if outside else title
