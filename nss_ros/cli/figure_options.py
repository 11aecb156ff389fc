"""Options of commands that write figures as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from nss_ros.benchmark.figure_files import figures_of
from nss_ros.benchmark.run import Run
from nss_ros.dataset.figures import write_figure
from nss_ros.errors import InputError

FiguresOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Also write each figure as a file in here.")
]
EndingOption = Annotated[str, typer.Option(help="Format of these files: png, svg or pdf.")]
WorstOption = Annotated[
    int, typer.Option(min=0, help="Wrong pairs of each log that are shown as pictures.")
]

_ENDINGS = ("png", "svg", "pdf")


def check_ending(ending: str) -> None:
    """Raises InputError if figures cannot be written so."""
    if ending not in _ENDINGS:
        raise InputError(f"A figure cannot be '{ending}': choose one of {', '.join(_ENDINGS)}.")


def write_figures(runs: Sequence[Run], worst: int, folder: Path, ending: str) -> list[Path]:
    """Writes all figures for which there are data; the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, figure in figures_of(runs, worst):
        written.append(folder / f"{name}.{ending}")
        write_figure(written[-1], figure)
    return written
