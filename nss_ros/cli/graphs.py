"""`nss graphs`: pose graphs of a dataset, as the paper or as its challenge makes them."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import DatasetArgument
from nss_ros.config import load_config
from nss_ros.dataset.annotate import AddedGraphs, GraphKind, add_graphs
from nss_ros.dataset.challenge import ChallengeGraph
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.splits import Split
from nss_ros.table import Align, Column, Table


class SplitChoice(StrEnum):
    """Whose sets the graphs are of."""

    ORIGINAL = "original"
    CROSS_AREA = "cross_area"
    CROSS_STAGE = "cross_stage"
    ALL = "all"


def graphs(
    dataset: DatasetArgument,
    kind: Annotated[
        GraphKind,
        typer.Option(help="20 to 160 nodes with outliers, or one graph per connected area."),
    ] = GraphKind.CHALLENGE,
    split: Annotated[
        SplitChoice, typer.Option(help="Make graphs of each set of a split, or of all pairs.")
    ] = SplitChoice.ALL,
    count: Annotated[
        int | None, typer.Option(min=1, help="Challenge graphs of each area and set.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the challenge graphs.")] = 0,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Make pose graphs with ground truth from the pairs of a dataset.

    Challenge graphs are written to pose_graph/<set>/, which makes the dataset a folder of the NSS
    challenge: 'nss import DATASET -o bag' takes it. Multi-way graphs are written to
    multiway_graph/<split>/<set>/.
    """
    overrides = list(set_)
    if count is not None:
        overrides.append(f"dataset.graphs.graphs_per_area={count}")
    settings = load_config(config, overrides).dataset.graphs
    folder = DatasetFolder(dataset)
    chosen = None if split is SplitChoice.ALL else Split(split)
    made = add_graphs(folder, kind, chosen, settings, seed)
    if json:
        print_json(_summary(made))
        return
    console = Console()
    console.print(_table(made).to_rich())
    for sentence in made.skipped:
        console.print(sentence, style="yellow", soft_wrap=True)
    console.print(f"Graphs: {made.folder}", soft_wrap=True, highlight=False)


def _figures(graphs: list[ChallengeGraph]) -> dict[str, Any]:
    edges = [edge for graph in graphs for edge in graph.edges or ()]
    nodes = [node for graph in graphs for node in graph.nodes]
    overlaps = [edge.overlap_ratio for edge in edges]
    return {
        "graphs": len(graphs),
        "nodes": len(nodes),
        "outliers": sum(node.outlier for node in nodes),
        "same_stage_edges": sum(bool(edge.same_stage) for edge in edges),
        "different_stage_edges": sum(not edge.same_stage for edge in edges),
        "mean_overlap_ratio": float(np.mean(overlaps)) if overlaps else float("nan"),
    }


def _summary(made: AddedGraphs) -> dict[str, Any]:
    return {
        "folder": str(made.folder),
        "sets": {name: _figures(graphs) for name, graphs in made.graphs.items()},
        "skipped": list(made.skipped),
    }


def _table(made: AddedGraphs) -> Table:
    return Table(
        "Graphs",
        (
            Column("set", align=Align.LEFT),
            Column("graphs"),
            Column("nodes"),
            Column("outliers"),
            Column("same-stage edges"),
            Column("different-stage edges"),
            Column("mean overlap ratio", form=".2f"),
        ),
        tuple((name, *_figures(graphs).values()) for name, graphs in made.graphs.items()),
    )
