"""`nss stats`: the tables and plots of a dataset."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import DatasetArgument
from nss_ros.cli.progress import progress_bar
from nss_ros.cli.table_format import (
    FormatOption,
    TableFormat,
    TableOption,
    chosen_tables,
    print_tables,
)
from nss_ros.dataset.bag_export import ground_truth_graph
from nss_ros.dataset.figures import pair_figure, plan_figure, spatiotemporal_figure, write_figure
from nss_ros.dataset.folder import PAIRS_NAME, DatasetFolder
from nss_ros.dataset.pairs import read_pairs
from nss_ros.dataset.ply import count_vertices
from nss_ros.dataset.statistics import MIN_OVERLAP, dataset_tables
from nss_ros.fragment import FragmentId
from nss_ros.simulation.fragment_picture import (
    fragment_picture,
    normal_colours,
    panorama_picture,
)
from nss_ros.simulation.picture import write_png
from nss_ros.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def stats(
    dataset: DatasetArgument,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Also write plots into this folder."),
    ] = None,
    ending: Annotated[str, typer.Option(help="Format of the plots: png, svg or pdf.")] = "png",
    form: FormatOption = TableFormat.RICH,
    table: TableOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the tables as JSON.")] = False,
) -> None:
    """Print the tables of a dataset: areas, pairs, splits, graphs.

    The plots are the paper's: all pairs and selected pairs by overlap ratio, temporal change
    ratio and complexity; for each area its spots with the pairs that overlap; and a fragment.
    """
    folder = DatasetFolder(dataset)
    with progress_bar(quiet=json) as progress:
        task = progress.add_task("fragments", total=folder.manifest.fragment_count() or None)

        def report(_: FragmentId) -> None:
            progress.advance(task)

        tables = dataset_tables(folder, report)
    chosen = chosen_tables(tables, table)
    written = _write_figures(folder, output, ending) if output else []
    if json:
        print_json({table.title: _records(table) for table in chosen})
        return
    print_tables(chosen, (), form)
    for path in written:
        Console(stderr=True).print(f"Wrote {path}", soft_wrap=True, highlight=False)


def _write_figures(dataset: DatasetFolder, output: Path, ending: str) -> list[Path]:
    output.mkdir(parents=True, exist_ok=True)
    written = []
    for name, figure in _figures(dataset):
        path = output / f"{name}.{ending}"
        write_figure(path, figure)
        written.append(path)
    return written + _write_fragment(dataset, output)


def _write_fragment(dataset: DatasetFolder, output: Path) -> list[Path]:
    """Pictures of the fragment with most points, and of its panorama if there is one."""
    ids = dataset.fragment_ids()
    if not ids:
        return []
    largest = max(ids, key=lambda id_: count_vertices(dataset.point_file(id_)))
    columns = dataset.columns(largest)
    images = {"fragment": fragment_picture(columns.points, normal_colours(columns.normals))}
    if (depth := dataset.panorama(largest)) is not None:
        images["panorama"] = panorama_picture(depth)
    written = []
    for name, image in images.items():
        written.append(output / f"{name}_{largest}.png")
        write_png(written[-1], image, colours=256)
    return written


def _figures(dataset: DatasetFolder) -> Iterator[tuple[str, Figure]]:
    if not (dataset.path / PAIRS_NAME).exists():
        return
    pairs = read_pairs(dataset.path / PAIRS_NAME)
    yield "pairs_all", pair_figure(pairs, selected=False)
    yield "pairs_selected", pair_figure(pairs, selected=True)
    linked = pairs.take(pairs.overlap_ratio >= MIN_OVERLAP)
    for area in dataset.areas():
        graph = ground_truth_graph(dataset, area, linked)
        yield f"plan_{area}", plan_figure(graph)
        yield f"graph_{area}", spatiotemporal_figure(graph)


def _records(table: Table) -> list[dict[str, Any]]:
    names = [column.heading for column in table.columns]
    return [dict(zip(names, row, strict=True)) for row in table.rows]
