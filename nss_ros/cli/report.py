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
from nss_ros.cli.figure_options import (
    EndingOption,
    FiguresOption,
    WorstOption,
    check_ending,
    write_figures,
)
from nss_ros.errors import InputError
from nss_ros.files import write_file


def report(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Log folders, as written by 'nss map'.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="HTML file to write.")
    ] = Path("report.html"),
    worst: WorstOption = 8,
    figures: FiguresOption = None,
    ending: EndingOption = "png",
    resamplings: ResamplingsOption = 1000,
    seed: SeedOption = 0,
    by_fragment: ByFragmentOption = False,
) -> None:
    """Write a report of logs: one HTML file that needs no network and no other file.

    It has the headline figures with bootstrap intervals, all tables of 'nss score', figures of
    accuracy, graph and timing, the map in 3-D by stage, the worst pairs as pictures, and pairs by
    their ids. What a log lacks (ground truth, point clouds, a map) is left out, and said.
    """
    check_ending(ending)
    if output.is_dir():
        raise InputError(f"{output} is a folder: name the HTML file to write, with --output.")
    if not output.parent.is_dir():
        raise InputError(f"There is no folder {output.parent} to write {output.name} into.")
    bootstrap = Bootstrap(resamplings, seed, by_fragment=by_fragment)
    runs = [read_run(log, bootstrap) for log in logs]
    write_file(output, html_report(runs, worst).encode())
    written = [output]
    if figures is not None:
        written += write_figures(runs, worst, figures, ending)
    for path in written:
        Console(stderr=True).print(f"Wrote {path}", soft_wrap=True, highlight=False)
