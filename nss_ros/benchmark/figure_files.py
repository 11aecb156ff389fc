"""The figures of runs, drawn for files, each with a name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from nss_ros.benchmark.chart_drawing import draw
from nss_ros.benchmark.figures import rmse_by_graph_size, run_charts
from nss_ros.benchmark.map_figures import (
    before_after_figure,
    graph_chart,
    map_figure,
    stage_figure,
)
from nss_ros.benchmark.map_view import chained_view, map_views
from nss_ros.benchmark.pair_list import pair_chart
from nss_ros.benchmark.pair_records import pair_records
from nss_ros.benchmark.run import Run
from nss_ros.benchmark.worst_pairs import pair_figure, worst_pairs

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figures_of(runs: Sequence[Run], worst: int) -> Iterator[tuple[str, Figure]]:
    """All figures for which there are data; with several runs, names begin with the run's.

    Args:
        runs: one or more.
        worst: pairs of each run that are drawn.
    """
    scores = [run.score for run in runs if run.score is not None]
    size = rmse_by_graph_size(scores)
    if size is not None:
        yield "rmse_by_graph_size", draw(size)
    names = _distinct([run.name for run in runs])
    for run, name in zip(runs, names, strict=True):
        prefix = f"{name}_" if len(runs) > 1 else ""
        for what, figure in _run_figures(run, worst):
            yield prefix + what, figure


def _run_figures(run: Run, worst: int) -> Iterator[tuple[str, Figure]]:
    for name, chart in run_charts(run).items():
        yield name, draw(chart)
    for view in map_views(run.log):
        if run.log.pose_graph is not None:
            yield f"graph_{view.key}", draw(graph_chart(run.log.pose_graph, view, {}))
        if not view.points:
            continue
        yield f"map_{view.key}", map_figure(view)
        yield f"stages_{view.key}", stage_figure(view)
        before = chained_view(run.log, view)
        if before is not None:
            yield f"before_after_{view.key}", before_after_figure(before, view)
    records = pair_records(run.log, run.evaluation)
    spots = pair_chart(records, {})
    if spots is not None:
        yield "pairs", draw(spots)
    if run.evaluation is not None:
        for each in worst_pairs(run.log, records, worst):
            pair = each.record.pair
            figure = pair_figure(run.log, run.evaluation, each.record)
            yield f"pair_{pair.source}_{pair.target}", figure


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, with numbers where they are alike."""
    return [
        f"{name}_{number + 1}" if names.count(name) > 1 else name
        for number, name in enumerate(names)
    ]
