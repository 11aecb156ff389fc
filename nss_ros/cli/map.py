"""`nss map` and `nss demo`: run the graph."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from nss_ros.cli.output import print_json
from nss_ros.config import load_config
from nss_ros.errors import InputError
from nss_ros.multiway.pose_graph import doubtful_sentence

if TYPE_CHECKING:
    from nss_ros.nodes.monitor import Progress as RunProgress

BagsArgument = Annotated[
    list[Path],
    typer.Argument(metavar="BAG", help="rosbag2 MCAP bags, played one after the other."),
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="Settings, as written by 'nss config'.")
]
SetOption = Annotated[
    list[str],
    typer.Option(
        "--set", "-s", metavar="NAME=VALUE", help="One setting, e.g. registration.method=fpfh_fgr."
    ),
]


def map_(
    bags: BagsArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the log to write.")],
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    method: Annotated[str, typer.Option(help="Registration method; see 'nss methods'.")] = "",
    synchronizer: Annotated[str, typer.Option(help="Multi-way method; see 'nss methods'.")] = "",
    seed: Annotated[int | None, typer.Option(help="Seed of everything random.")] = None,
    rate: Annotated[
        float | None,
        typer.Option(help="Speed against recorded time; 0 (the default): as fast as possible."),
    ] = None,
    registration_nodes: Annotated[
        int, typer.Option(min=1, help="Registration nodes that share the pairs.")
    ] = 1,
    namespace: Annotated[str, typer.Option(help="Namespace of all nodes and topics.")] = "",
    timeout: Annotated[
        float, typer.Option(min=0, help="Give up after this many seconds; 0: never.")
    ] = 0.0,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Register bags into one map with the real ROS graph, and record it all in a log.

    Starts the nodes fragment_player, registration, pose_graph and recorder as processes, ends
    when every pair is answered and the map has settled, and exits with 1 naming the node that
    died if one did.
    """
    overrides = list(set_)
    overrides += [f"player.rate={rate}"] if rate is not None else []
    overrides += [f"registration.method={method}"] if method else []
    overrides += [f"pose_graph.synchronizer={synchronizer}"] if synchronizer else []
    overrides += [f"registration.seed={seed}"] if seed is not None else []
    settings = load_config(config, overrides, defaults=["player.rate=0"])
    run_mapping = _import_mapping()
    begin = time.monotonic()
    try:
        with ProgressDisplay(quiet=json) as display:
            progress = run_mapping(
                bags,
                output,
                settings,
                namespace=namespace,
                registration_nodes=registration_nodes,
                timeout=timeout,
                report=display.update,
            )
    except KeyboardInterrupt:
        if output.exists():
            sentence = f"Interrupted: what was recorded until then is in {output}."
            Console(stderr=True).print(sentence, soft_wrap=True, highlight=False, markup=False)
        raise
    seconds = time.monotonic() - begin
    if json:
        print_json(
            {
                "log": str(output),
                "seconds": seconds,
                "fragments": progress.fragments_total,
                "pairs": progress.pairs_total,
                "pairs_failed": progress.pairs_failed,
                "placed": progress.placed,
                "components": progress.components,
                "doubtful": progress.doubtful,
                "rms_residual": progress.rms_residual,
                "warnings": progress.warnings,
            }
        )
        return
    console = Console()
    for warning in progress.warnings:
        console.print(warning, style="yellow", soft_wrap=True, highlight=False)
    console.print(
        f"Placed {progress.placed} of {progress.fragments_total} fragments in the largest of "
        f"{progress.components} component(s), RMS residual {_metres(progress.rms_residual)}; "
        f"{progress.pairs_total} pairs, {progress.pairs_failed} without an answer that holds; "
        f"{seconds:.0f} s.{_doubts(progress.doubtful)}\nLog: {output}",
        highlight=False,
        soft_wrap=True,
    )


class ProgressDisplay:
    """Fragments, pairs and the map's state on the terminal; one line each, updated in place."""

    def __init__(self, quiet: bool = False) -> None:
        self._display = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._fragments = self._display.add_task("fragments", total=None, note="")
        self._pairs = self._display.add_task("pairs", total=None, note="")
        self._placed = self._display.add_task("placed", total=None, note="")

    def __enter__(self) -> ProgressDisplay:
        return self

    def __exit__(self, *_: object) -> None:
        self._display.stop()

    def update(self, run: RunProgress) -> None:
        """Show the state of the run; nothing before the player was heard of."""
        if not run.playing:
            return
        self._display.start()
        self._display.update(self._fragments, completed=run.fragments, total=run.fragments_total)
        failures = f"{run.pairs_failed} failed" if run.pairs_failed else ""
        self._display.update(
            self._pairs, completed=run.pairs_answered, total=run.pairs_total, note=failures
        )
        note = f"{run.components} component(s), RMS residual {_metres(run.rms_residual)}"
        self._display.update(
            self._placed, completed=run.placed, total=run.fragments_total, note=note
        )


def _doubts(ids: Sequence[str]) -> str:
    return f"\n{doubtful_sentence(ids)}" if ids else ""


def _metres(value: float) -> str:
    return f"{value:.3f} m" if math.isfinite(value) else "-"


def _import_mapping() -> Callable[..., RunProgress]:
    try:
        from nss_ros.nodes.mapping import run_mapping
    except ImportError as error:
        raise InputError(
            f"This command needs ROS 2 Jazzy and the package nss_msgs ({error}): run it as "
            "'./nss', or source the workspace that you built with colcon."
        ) from error
    return run_mapping
