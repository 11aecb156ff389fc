"""`nss simulate`: a bag of a synthetic construction floor."""

from __future__ import annotations

import math
import time
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from nss_ros.bag import write_bag
from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.config import load_config
from nss_ros.errors import BagError
from nss_ros.multiway.pose_graph import Edge, EdgeKind, PoseGraph
from nss_ros.simulation.simulator import Scan, bag_metadata, ground_truth_graph, simulate_scans


def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the bag to write.")],
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of everything random.")] = None,
    spots_per_stage: Annotated[
        int | None, typer.Option(min=1, help="Most tripod spots per stage.")
    ] = None,
    stages: Annotated[int | None, typer.Option(min=1, max=3, help="Number of stages.")] = None,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Build a construction floor in stages, scan it, and write a bag with ground truth.

    The same seed and settings give the same points.
    """
    overrides = list(set_)
    overrides += [f"simulation.seed={seed}"] if seed is not None else []
    overrides += [f"simulation.site.stages={stages}"] if stages is not None else []
    if spots_per_stage is not None:
        overrides.append(f"simulation.viewpoints.spots_per_stage={spots_per_stage}")
    settings = load_config(config, overrides).simulation
    if output.exists():
        raise BagError(f"{output} exists already: choose another name or remove it.")
    begin = time.monotonic()
    with _progress(quiet=json) as progress:
        total = settings.site.stages * settings.viewpoints.spots_per_stage
        task = progress.add_task("fragments", total=total)
        scans = simulate_scans(settings, lambda _: progress.advance(task))
        scanned = time.monotonic()
        progress.update(task, total=len(scans))
        progress.add_task("pairs", total=None)
        graph = ground_truth_graph(settings, scans)
    write_bag(
        output,
        [scan.fragment for scan in scans],
        [edge.pair for edge in graph.edges],
        [graph],
        bag_metadata(settings),
    )
    summary = _summary(output, scans, graph)
    summary["seconds_fragments"] = scanned - begin
    summary["seconds"] = time.monotonic() - begin
    if json:
        print_json(summary)
    else:
        _print(summary)


def _progress(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description:<10}"),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        disable=quiet,
    )


def _summary(output: Path, scans: list[Scan], graph: PoseGraph) -> dict[str, Any]:
    kinds = {"same_stage": EdgeKind.SAME_STAGE, "different_stage": EdgeKind.DIFFERENT_STAGE}
    stages = sorted({scan.fragment.id.stage for scan in scans})
    return {
        "bag": str(output),
        "bytes": sum(file.stat().st_size for file in output.iterdir()),
        "fragments": len(scans),
        "fragments_per_stage": {
            str(stage): sum(scan.fragment.id.stage == stage for scan in scans) for stage in stages
        },
        "points": sum(len(scan.fragment.points) for scan in scans),
        "pairs": len(graph.edges),
        **{
            name: _pair_figures([edge for edge in graph.edges if edge.kind is kind])
            for name, kind in kinds.items()
        },
    }


def _pair_figures(edges: list[Edge]) -> dict[str, float]:
    changes = [e.temporal_change for e in edges if math.isfinite(e.temporal_change)]
    return {
        "pairs": len(edges),
        "median_overlap_ratio": median([e.overlap_ratio for e in edges]) if edges else math.nan,
        "median_temporal_change": median(changes) if changes else math.nan,
    }


def _print(summary: dict[str, Any]) -> None:
    table = Table("pairs", "count", "median overlap ratio", "median temporal change")
    for name in ("same_stage", "different_stage"):
        figures = summary[name]
        table.add_row(
            name.replace("_", "-"),
            str(figures["pairs"]),
            f"{figures['median_overlap_ratio']:.2f}",
            f"{figures['median_temporal_change']:.2f}",
        )
    console = Console()
    console.print(table)
    per_stage = ", ".join(
        f"stage {stage}: {count}" for stage, count in summary["fragments_per_stage"].items()
    )
    console.print(
        f"{summary['fragments']} fragments ({per_stage}), {summary['points']:,} points, "
        f"{summary['bytes'] / 1e6:.1f} MB, {summary['seconds']:.0f} s.\nBag: {summary['bag']}",
        highlight=False,
        soft_wrap=True,
    )
