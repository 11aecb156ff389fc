"""`nss demo`: the main job on the bundled bag."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.cli.map import map_
from nss_ros.cli.score import score
from nss_ros.errors import InputError

_BAG = Path(__file__).parents[2] / "bags" / "three_stages"


def demo(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder of the log to write.")
    ] = None,
) -> None:
    """Map the bundled three-stage bag with the real ROS graph, then score the log."""
    if not _BAG.is_dir():
        raise InputError(f"The bundled bag {_BAG} is missing: run this from a clone of nss_ros.")
    log = output or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    console = Console()
    console.print(f"[bold]nss map {_BAG} -o {log}[/bold]", soft_wrap=True)
    map_([_BAG], log)
    console.print(f"\n[bold]nss score {log}[/bold]", soft_wrap=True)
    score([log])
