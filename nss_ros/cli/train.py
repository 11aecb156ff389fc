"""`nss train`: a learned baseline learns from the training pairs of a dataset."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import DatasetArgument
from nss_ros.cli.progress import progress_bar
from nss_ros.config import load_config
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.splits import Split

if TYPE_CHECKING:
    from nss_ros.registration.learned.training.loop import Report


def train(
    dataset: DatasetArgument,
    method: Annotated[
        str,
        typer.Option("--method", "-m", help="fcgf, d3feat, predator or geotransformer."),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="File of the weights; one cut short is completed."),
    ],
    split: Annotated[
        Split, typer.Option(help="Whose training pairs are learned from.")
    ] = Split.CROSS_AREA,
    same_stage_only: Annotated[
        bool,
        typer.Option("--same-stage-only", help="Leave pairs of different stages out."),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a learned baseline of the NSS paper on a dataset that has pairs.

    The weights are used by 'registration.METHOD.weights', with the voxel size of the training.
    Test pairs are never read. A run that was cut short is completed by the same command.
    Settings are those of the section 'training'; a GPU is used if there is one.
    """
    # PyTorch takes seconds to import, which no other command shall wait for.
    from nss_ros.registration.learned.training.run import Training
    from nss_ros.registration.learned.training.run import train as train_method

    settings = load_config(config, set_)
    begin = time.monotonic()
    reports: list[Report] = []
    with progress_bar(quiet=json) as progress:
        task = progress.add_task(method, total=settings.training.steps)

        def told(report: Report) -> None:
            progress.update(task, completed=report.step)
            if report.validation is not None:
                reports.append(report)
                progress.console.print(_line(report), highlight=False)

        training = Training(DatasetFolder(dataset), method, split, same_stage_only, seed)
        record = train_method(training, output, settings, told)
    seconds = time.monotonic() - begin
    if json:
        print_json(
            {
                "weights": str(output),
                "record": asdict(record),
                "losses": [asdict(report) for report in reports],
                "seconds": seconds,
            }
        )
        return
    Console().print(
        f"{seconds:.0f} s, {record.count:,} pairs to learn from. Weights: {output}, used by "
        f"--set registration.{method}.weights={output} "
        f"--set registration.{method}.voxel_size={record.voxel_size:g}",
        highlight=False,
        soft_wrap=True,
    )


def _line(report: Report) -> str:
    losses = ", ".join(f"{name} {value:.3f}" for name, value in report.losses.items())
    validation = report.validation
    told = validation is not None and not math.isnan(validation)
    return f"step {report.step:,}: {losses}" + (f"; validation {validation:.3f}" if told else "")
