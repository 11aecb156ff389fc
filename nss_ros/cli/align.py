"""`nss align`: a user's own stage scans brought into the frame of one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.config import load_config
from nss_ros.dataset.alignment import StageAlignment, align_stages
from nss_ros.dataset.manifest import write_json
from nss_ros.dataset.ply import read_ply
from nss_ros.errors import InputError
from nss_ros.fragment import clean_points
from nss_ros.table import Column, Table


def align(
    picks: Annotated[
        Path,
        typer.Argument(
            metavar="PICKS",
            help="Picked points, YAML or CSV: for each stage three or more pairs of a point in it "
            "and the same point in the anchor stage, metres.",
        ),
    ],
    scans: Annotated[
        list[str],
        typer.Argument(metavar="STAGE=PLY...", help="Scan of each stage, e.g. 1=shell.ply."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="JSON file of the transforms.")
    ] = Path("alignment.json"),
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the transforms as JSON.")] = False,
) -> None:
    """Align the scans of several stages to one of them: by picked points, then by ICP."""
    settings = load_config(config, set_).dataset.alignment
    clouds = {}
    for scan in scans:
        stage, separator, name = scan.partition("=")
        if not separator or not stage.isdecimal():
            raise InputError(f"'{scan}' needs the form STAGE=PLY, for example 1=shell.ply.")
        clouds[int(stage)] = clean_points(read_ply(Path(name)))
    found = align_stages(picks, clouds, settings)
    result = {str(stage): _record(each) for stage, each in found.items()}
    write_json(output, result)
    if json:
        print_json(result)
        return
    console = Console()
    console.print(_table(found).to_rich())
    for each in found.values():
        for sentence in each.warnings:
            console.print(sentence, style="yellow", soft_wrap=True, highlight=False)
    console.print(f"Transforms: {output}", soft_wrap=True, highlight=False)


def _record(alignment: StageAlignment) -> dict[str, object]:
    return {
        "T_anchor_stage": alignment.T_anchor_stage.tolist(),
        "residuals": alignment.residuals.tolist(),
        "warnings": list(alignment.warnings),
    }


def _table(found: dict[int, StageAlignment]) -> Table:
    columns = (
        Column("stage"),
        Column("picks"),
        Column("worst pick", "m", ".3f"),
        Column("moved by ICP", "m", ".3f"),
        Column("residual of ICP", "m", ".3f"),
    )
    rows = tuple(
        (
            stage,
            len(each.residuals),
            float(each.residuals.max()) if len(each.residuals) else None,
            each.correction,
            each.rmse,
        )
        for stage, each in found.items()
    )
    return Table("Stages in the frame of the anchor stage", columns, rows)
