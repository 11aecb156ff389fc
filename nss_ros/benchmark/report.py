"""The report of one run or several: one HTML file that needs nothing else, not even a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from nss_ros import __version__
from nss_ros.benchmark.chart import Chart, Series
from nss_ros.benchmark.chart_drawing import draw
from nss_ros.benchmark.chart_plotly import plotly_figure
from nss_ros.benchmark.figures import missing_charts, rmse_by_graph_size, run_charts
from nss_ros.benchmark.headline_cards import Card, cards
from nss_ros.benchmark.map_figures import (
    SECTION_DEPTH,
    before_after_figure,
    graph_chart,
    map_figure,
    stage_figure,
)
from nss_ros.benchmark.map_model import map_model
from nss_ros.benchmark.map_view import MapView, chained_view, map_views, most_important
from nss_ros.benchmark.pair_list import pair_chart, pair_table
from nss_ros.benchmark.pair_records import Outcome, PairRecord, pair_records
from nss_ros.benchmark.report_images import Image, drawing, photograph
from nss_ros.benchmark.run import Run
from nss_ros.benchmark.run_facts import facts
from nss_ros.benchmark.table import log_tables, run_tables
from nss_ros.benchmark.worst_pairs import pair_figure, worst_pairs
from nss_ros.fragment import FragmentPair
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.table import Table

MOST_ROWS = 2000
"""Pairs listed of a run, worst first."""
MOST_POINTS = 160_000
"""Points of the 3-D views of all runs together."""

MOST_VIEWS = 12
"""Components of areas drawn of a run; each has its pictures, some hundred kilobytes."""

_MOST_NAMED = 6
_PAPER = ("pairwise", "multiway", "map", "areas", "displacement", "paper", "training")
_BINS = ("overlap_bins", "change_bins", "overlap", "calibration", "reliability", "intervals")


@dataclass(frozen=True, slots=True)
class Plot:
    """A chart on the page.

    Attributes:
        chart: what is shown.
        picture: for print and where no script runs.
        keys: of its panels in the data of the page.
    """

    chart: Chart
    picture: Image
    keys: list[str]
    legend: list[Series]


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture on the page.

    Attributes:
        title: of the picture, also for those who cannot see it.
        picture: the picture.
        caption: how it is to be read; may be empty.
    """

    title: str
    picture: Image
    caption: str = ""


@dataclass(frozen=True, slots=True)
class WorstOnPage:
    """One of the worst pairs on the page."""

    record: PairRecord
    why: str
    row: str
    picture: Image


@dataclass(slots=True)
class RunOnPage:
    """All that the page shows of one run."""

    key: str
    name: str
    run: Run
    facts: list[tuple[str, str]]
    notes: tuple[str, ...]
    cards: list[Card] = field(default_factory=list)
    models: list[str] = field(default_factory=list)
    stages: list[tuple[int, str]] = field(default_factory=list)
    map_pictures: list[Picture] = field(default_factory=list)
    graphs: list[Plot] = field(default_factory=list)
    plots: dict[str, Plot] = field(default_factory=dict)
    tables: dict[str, Table] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    worst: list[WorstOnPage] = field(default_factory=list)
    pair_table: Table | None = None
    pair_ids: list[str] = field(default_factory=list)
    outcomes: list[tuple[str, int]] = field(default_factory=list)
    settings: str = ""
    metadata: list[tuple[str, str]] = field(default_factory=list)


def report(runs: Sequence[Run], worst: int = 8, most_points: int = MOST_POINTS) -> str:
    """The HTML page.

    Args:
        runs: one or more.
        worst: pairs that are shown as pictures, of each run.
        most_points: of the 3-D views of all runs together.
    """
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    data: dict[str, Any] = {"plots": {}, "maps": {}}
    pages = [
        _run_page(f"r{number}", run, worst, most_points // len(runs), data)
        for number, run in enumerate(runs)
    ]
    shared = _shared(runs, data) if len(runs) > 1 else None
    page = files("nss_ros.benchmark") / "report_page"
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                              lstrip_blocks=True)  # fmt: skip
    environment.filters["table"] = lambda table, ids=(): Markup(table.to_html(ids))
    template = environment.from_string((page / "page.html").read_text(encoding="utf-8"))
    names = ", ".join(run.name for run in runs)
    return template.render(
        title=f"nss_ros: {names}",
        names=names,
        version=__version__,
        runs=pages,
        shared=shared,
        several=len(runs) > 1,
        paper=_PAPER,
        details=_BINS,
        style=Markup((page / "page.css").read_text(encoding="utf-8")),
        script=Markup((page / "page.js").read_text(encoding="utf-8")),
        # Inside a script element only "</" could end it.
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
        data=Markup(json.dumps(data, separators=(",", ":")).replace("</", "<\\/")),
    )


@dataclass(frozen=True, slots=True)
class _Shared:
    tables: dict[str, Table]
    plots: list[Plot]


def _shared(runs: Sequence[Run], data: dict[str, Any]) -> _Shared | None:
    scores = [run.score for run in runs if run.score is not None]
    if len(scores) < 2:
        return None
    chart = rmse_by_graph_size(scores)
    plots = [_plot("shared-size", chart, data)] if chart is not None else []
    return _Shared(run_tables(scores), plots)


def _run_page(key: str, run: Run, worst: int, most_points: int, data: dict[str, Any]) -> RunOnPage:
    page = RunOnPage(key, run.name, run, facts(run), run.notes)
    records = pair_records(run.log, run.evaluation)
    rows = {record.pair: f"{key}-p{i + 1}" for i, record in enumerate(records[:MOST_ROWS])}
    _add_maps(page, rows, most_points, data)
    for name, chart in run_charts(run).items():
        page.plots[name] = _plot(f"{key}-{name}", chart, data)
    if run.score is not None:
        page.cards = cards(run.score.headline)
        page.tables = log_tables(run.score)
        page.missing = missing_charts(run)
        size = rmse_by_graph_size([run.score])
        if size is not None:
            page.plots["size"] = _plot(f"{key}-size", size, data)
    if run.evaluation is not None:
        page.worst = [
            WorstOnPage(
                each.record,
                each.why,
                rows.get(each.record.pair, ""),
                photograph(pair_figure(run.log, run.evaluation, each.record)),
            )
            for each in worst_pairs(run.log, records, worst)
        ]
    spots = pair_chart(records, rows)
    if spots is not None:
        page.plots["pairs"] = _plot(f"{key}-pairs-chart", spots, data)
    if records:
        page.pair_ids = list(rows.values())
        page.pair_table = pair_table(
            records[:MOST_ROWS], len(records), scored=run.evaluation is not None
        )
        page.outcomes = [
            (outcome.word, count)
            for outcome in Outcome
            if (count := sum(record.outcome is outcome for record in records[:MOST_ROWS]))
        ]
    metadata = dict(run.log.metadata)
    page.settings = _pretty(metadata.pop("config", ""))
    page.metadata = sorted(metadata.items())
    return page


def _add_maps(
    page: RunOnPage, rows: Mapping[FragmentPair, str], most_points: int, data: dict[str, Any]
) -> None:
    log = page.run.log
    views = map_views(log)
    if log.pose_graph is None or not views:
        return
    shown = most_important(views, MOST_VIEWS)
    page.notes = (*page.notes, *_not_drawn(log.pose_graph, views, shown))
    for number, view in enumerate(shown):
        chart = graph_chart(log.pose_graph, view, rows)
        page.graphs.append(_plot(f"{page.key}-graph{number}", chart, data))
        if not view.points:
            continue
        name = f"{page.key}-map{number}"
        data["maps"][name] = map_model(view, most_points // len(shown))
        page.models.append(name)
        how = ""
        if len(view.points) > 1:
            how = " Stages are printed over each other: dark is what several saw."
        if not view.level:
            how += " The fragments are not levelled: up is taken to be where the map is thinnest."
        page.map_pictures.append(
            Picture(
                f"{view.title}: all stages" if len(view.points) > 1 else view.title,
                photograph(map_figure(view)),
                "Plan: what stands 0.25 to 2.1 m above the floor. Section: what lies within "
                f"{SECTION_DEPTH:g} m of the dotted line.{how}",
            )
        )
        if len(view.points) > 1:
            page.map_pictures.append(
                Picture(f"{view.title}: stage by stage", photograph(stage_figure(view)))
            )
        before = chained_view(log, view)
        if before is not None:
            page.map_pictures.append(
                Picture(
                    f"{view.title}: before and after the multi-way step",
                    photograph(before_after_figure(before, view)),
                    "Before: the same fragments, chained by the most confident relative transforms."
                    + (
                        " Aligned with the truth so that most spots are in place."
                        if len(view.gaps)
                        else ""
                    ),
                )
            )


def _not_drawn(graph: PoseGraph, views: Sequence[MapView], shown: Sequence[MapView]) -> list[str]:
    """One sentence for each thing of the map that no picture shows."""
    result = []
    torn = {view.area: view.parts for view in views if view.parts > 1}
    if torn:
        parts = ", ".join(f"area {area} in {count}" for area, count in torn.items())
        result.append(
            f"The map is in components that nothing links ({parts}): each is drawn by itself, "
            "and how they lie to each other is not known."
        )
    left = [view for view in views if not any(view is each for each in shown)]
    if left:
        fragments = sum(len(view.spots) for view in left)
        named = ", ".join(view.name for view in left[:_MOST_NAMED])
        more = f" and {len(left) - _MOST_NAMED} more" if len(left) > _MOST_NAMED else ""
        result.append(
            f"Of {len(views)} components of the areas {len(shown)} are drawn, the largest of each "
            f"area first; left out: {named}{more} ({fragments:,} "
            f"fragment{'s' * (fragments != 1)})."
        )
    unplaced = len(graph.nodes) - len(graph.poses())
    if unplaced:
        result.append(
            f"{unplaced:,} of {len(graph.nodes):,} fragments are in no component of the map, so "
            "no picture of it shows them."
        )
    return result


def _plot(key: str, chart: Chart, data: dict[str, Any]) -> Plot:
    keys = []
    for number, panel in enumerate(chart.panels):
        keys.append(f"{key}-{number}")
        data["plots"][keys[-1]] = plotly_figure(panel) | {"height": panel.height}
    legend = list(chart.legend())
    return Plot(chart, drawing(draw(chart, titled=False)), keys, legend if len(legend) > 1 else [])


def _pretty(text: str) -> str:
    try:
        return json.dumps(json.loads(text), indent=2) if text else ""
    except ValueError:
        return text
