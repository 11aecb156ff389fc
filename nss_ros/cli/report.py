"""`nss report`: a run as one HTML file, and its figures as files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.report import report as html_report
from nss_ros.benchmark.run import read_run
from nss_ros.cli.bootstrap_options import ByFragmentOption, ResamplingsOption, SeedOption
from nss_ros.errors import InputError
from nss_ros.files import write_file


def report(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Log folders, as written by 'nss map'.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="HTML file to write.")
    ] = Path("report.html"),
    worst: Annotated[
        int, typer.Option(min=0, help="Wrong pairs of each log that are shown as pictures.")
    ] = 8,
    resamplings: ResamplingsOption = 1000,
    seed: SeedOption = 0,
    by_fragment: ByFragmentOption = False,
) -> None:
    """Write a report of logs: one HTML file with figures, tables, the map in 3-D and the worst
    pairs. It needs no network and no other file.
    """
    if not output.parent.is_dir():
        raise InputError(f"There is no folder {output.parent} to write {output.name} into.")
    bootstrap = Bootstrap(resamplings, seed, by_fragment=by_fragment)
    page = html_report([read_run(log, bootstrap) for log in logs], worst)
    write_file(output, page.encode())
    Console(stderr=True).print(f"Wrote {output}", soft_wrap=True, highlight=False)
