"""`nss export`: a log's map in the formats of the challenge and of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.bag import read_log
from nss_ros.dataset.challenge import write_graphs
from nss_ros.dataset.submission import submission
from nss_ros.dataset.trajectory import WRITERS
from nss_ros.errors import InputError


def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log folder, from 'nss map'.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="File to write; its ending decides: .json a challenge submission, .g2o, .tum, "
            ".ply the merged map.",
        ),
    ],
) -> None:
    """Write a log's map as a challenge submission, or for other tools.

    A submission has one graph per imported graph, with its node ids; fragments outside a graph's
    main component are outliers (zero matrix).
    """
    if output.suffix != ".json" and output.suffix not in WRITERS:
        raise InputError(
            f"{output} must end in .json, {', '.join(WRITERS)}: the ending decides the format."
        )
    content = read_log(log, points=output.suffix == ".ply")
    console = Console()
    if content.partial:
        console.print("[bold yellow]PARTIAL: the log is truncated or was never closed.")
    if output.suffix == ".json":
        graphs = submission(content)
        write_graphs(output, graphs)
        nodes = [node for graph in graphs for node in graph.nodes]
        outliers = sum(node.outlier for node in nodes)
        message = f"{len(graphs)} graph(s), {len(nodes)} nodes, of them {outliers} outliers"
    else:
        message = f"{WRITERS[output.suffix](content, output)} fragments"
    console.print(f"Wrote {message}: {output}", soft_wrap=True, highlight=False)
