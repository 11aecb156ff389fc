"""`nss pairs`: how much the pairs of a dataset overlap and change, a balanced choice, splits."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.progress import progress_bar
from nss_ros.config import PairConfig, load_config
from nss_ros.dataset.annotate import SplitPairs, add_pairs
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.pairs import PairTable
from nss_ros.dataset.selection import selection_flatness
from nss_ros.parallel import Engine
from nss_ros.table import Align, Column, Table

DatasetArgument = Annotated[
    Path, typer.Argument(metavar="DATASET", help="Dataset folder, from 'nss simulate'.")
]
WorkersOption = Annotated[
    int, typer.Option(min=0, help="Processes; 0: one per core, or all of the Ray cluster.")
]
EngineOption = Annotated[
    Engine,
    typer.Option(help="Run on this machine, or on the Ray cluster that RAY_ADDRESS names."),
]


def pairs(
    dataset: DatasetArgument,
    seed: Annotated[int, typer.Option(min=0, help="Seed of selection and splits.")] = 0,
    select: Annotated[
        int | None,
        typer.Option(min=1, help="Choose this many same-stage and as many different-stage pairs."),
    ] = None,
    engine: EngineOption = Engine.LOCAL,
    workers: WorkersOption = 0,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Measure all pairs of a dataset, choose a balanced set, and split it as the paper does.

    Writes pairs.csv (overlap ratio, temporal change ratio, geometric complexity) and
    splits/{original,cross_area,cross_stage}/{train,val,test}.csv into the dataset.
    """
    overrides = list(set_)
    if select is not None:
        for kind in ("same_stage_pairs", "different_stage_pairs"):
            overrides.append(f"dataset.pairs.selection.{kind}={select}")
    settings = load_config(config, overrides).dataset
    folder = DatasetFolder(dataset)
    begin = time.monotonic()
    with progress_bar(quiet=json) as progress:
        tasks = {name: progress.add_task(name, total=None) for name in ("fragments", "pairs")}

        def report(name: str, done: int, total: int) -> None:
            progress.update(tasks[name], completed=done, total=total)

        made = add_pairs(folder, settings.pairs, settings.splits, seed, workers, engine, report)
    summary = _summary(dataset, made, settings.pairs) | {"seconds": time.monotonic() - begin}
    if json:
        print_json(summary)
        return
    console = Console()
    console.print(_table(made).to_rich())
    flatness = summary["flatness"]
    for kind, (before, after) in flatness.items():
        if math.isnan(after):  # none selected
            continue
        console.print(
            f"Evenness of the {kind.replace('_', '-')} pairs over overlap and change (1: flat): "
            f"{before:.2f} before, {after:.2f} after selection.",
            highlight=False,
            soft_wrap=True,
        )
    for sentence in made.skipped:
        console.print(sentence, style="yellow", soft_wrap=True)
    console.print(
        f"{summary['seconds']:.0f} s. Dataset: {dataset}", soft_wrap=True, highlight=False
    )


def _counts(table: PairTable) -> dict[str, int]:
    same = table.same_stage
    return {"same_stage": int(same.sum()), "different_stage": int((~same).sum())}


def _summary(dataset: Path, made: SplitPairs, config: PairConfig) -> dict[str, Any]:
    table = made.pairs
    return {
        "dataset": str(dataset),
        "overlapping": _counts(table),
        "eligible": _counts(table.take(table.overlap_ratio >= config.min_overlap)),
        "selected": _counts(table.take(table.selected)),
        "flatness": selection_flatness(table, config),
        "splits": {
            split: {name: _counts(part.take(part.selected)) for name, part in sets.items()}
            for split, sets in made.splits.items()
        },
        "skipped": list(made.skipped),
    }


def _table(made: SplitPairs) -> Table:
    rows = [("all pairs that overlap", _counts(made.pairs))]
    rows.append(("selected", _counts(made.pairs.take(made.pairs.selected))))
    for split, sets in made.splits.items():
        rows += [
            (f"{split}, {name}", _counts(part.take(part.selected))) for name, part in sets.items()
        ]
    return Table(
        "Pairs",
        (
            Column("pairs", align=Align.LEFT),
            Column("same stage"),
            Column("different stage"),
        ),
        tuple((name, *counts.values()) for name, counts in rows),
    )
