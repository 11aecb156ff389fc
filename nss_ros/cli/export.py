"""`nss export`: a log's map, or a dataset, in the formats of the benchmark and of other tools."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.bag import read_log
from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.progress import progress_bar
from nss_ros.config import load_config
from nss_ros.dataset.challenge import write_graphs
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.manifest import MANIFEST_NAME
from nss_ros.dataset.release_export import Exported, export_release
from nss_ros.dataset.submission import submission
from nss_ros.dataset.trajectory import WRITERS
from nss_ros.errors import InputError


class Layout(StrEnum):
    """How a dataset is laid out."""

    RELEASE = "release"


def export(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="Log folder, from 'nss map'; or a dataset, from 'nss simulate'."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="Of a log, the file to write; its ending decides: .json a challenge submission, "
            ".g2o, .tum, .ply the merged map. Of a dataset, the folder to create.",
        ),
    ],
    layout: Annotated[
        Layout | None,
        typer.Option(help="Of a dataset: the layout of the NSS release, the only one so far."),
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Write a log's map as a challenge submission or for other tools, or a dataset as a release.

    A submission has one graph per imported graph, with its node ids; fragments outside a graph's
    main component are outliers (zero matrix).

    A dataset with pairs becomes pointclouds/, panoramas/, annotations/<split>/<set>.json and
    annotations_multiway/<split>/<set>.json, which 'nss import' reads back.
    """
    if layout is not None or (log / MANIFEST_NAME).is_file():
        _export_dataset(log, output, config, set_, json)
        return
    if output.suffix != ".json" and output.suffix not in WRITERS:
        raise InputError(
            f"{output} must end in .json, {', '.join(WRITERS)}: the ending decides the format."
        )
    content = read_log(log, points=output.suffix == ".ply")
    console = Console(stderr=json)
    if content.partial:
        console.print("[bold yellow]PARTIAL: the log is truncated or was never closed.")
    if output.suffix == ".json":
        graphs = submission(content)
        write_graphs(output, graphs)
        nodes = [node for graph in graphs for node in graph.nodes]
        outliers = sum(node.outlier for node in nodes)
        summary = {"graphs": len(graphs), "nodes": len(nodes), "outliers": outliers}
        message = f"{len(graphs)} graph(s), {len(nodes)} nodes, of them {outliers} outliers"
    else:
        written = WRITERS[output.suffix](content, output)
        placed = len(content.pose_graph.poses()) if content.pose_graph else 0
        summary = {"fragments": written, "left_out": placed - written}
        message = f"{written} fragments"
    if json:
        print_json({"file": str(output), **summary})
        return
    console.print(f"Wrote {message}: {output}", soft_wrap=True, highlight=False)
    if left_out := summary.get("left_out"):
        console.print(
            f"Left out {left_out} fragments of other components: nothing links them to the largest "
            "one, so they have no place in its frame.",
            style="yellow",
            soft_wrap=True,
        )


def _export_dataset(
    path: Path, output: Path, config: Path | None, set_: list[str], json: bool
) -> None:
    settings = load_config(config, set_).dataset.graphs
    dataset = DatasetFolder(path)
    with progress_bar(quiet=json) as progress:
        task = progress.add_task("fragments", total=None)
        exported = export_release(
            dataset,
            output,
            settings,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    if json:
        print_json({"folder": str(output), **asdict(exported)})
        return
    _print_release(exported, output)


def _print_release(exported: Exported, output: Path) -> None:
    console = Console()
    for split, sets in exported.pairs.items():
        graphs = exported.graphs.get(split, {})
        parts = ", ".join(f"{name} {n} ({graphs.get(name, 0)})" for name, n in sets.items())
        console.print(f"{split}, pairs (multi-way graphs): {parts}", highlight=False)
    for sentence in exported.skipped:
        console.print(sentence, style="yellow", soft_wrap=True, highlight=False)
    console.print(
        f"Wrote {exported.fragments} fragments and {exported.panoramas} panoramas: {output}",
        soft_wrap=True,
        highlight=False,
    )
