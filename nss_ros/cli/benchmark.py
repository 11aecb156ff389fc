"""`nss benchmark`: methods over the pairs and splits of a dataset, without a ROS graph."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import TaskID

from nss_ros.bag import read_log, with_source_points
from nss_ros.batch.registering import Workforce
from nss_ros.batch.run import BatchResult, Choice, RunLog, run_benchmark
from nss_ros.batch.source import BatchSplit, PairChoice, open_source
from nss_ros.batch.timing import Timing
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.benchmark.score import LogScore, summarize
from nss_ros.benchmark.table import multiway_table, notes, pairwise_table
from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import EngineOption
from nss_ros.cli.progress import progress_bar
from nss_ros.cli.table_format import FormatOption, TableFormat, print_tables
from nss_ros.config import load_config
from nss_ros.errors import RunError
from nss_ros.parallel import Engine, run
from nss_ros.table import Align, Column, Table


def benchmark(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="Dataset folder, from 'nss simulate', or a bag with ground truth.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder of the results; one cut short is completed."),
    ],
    method: Annotated[
        list[str],
        typer.Option("--method", "-m", help="Registration method; may be given again."),
    ] = [],  # noqa: B006 - typer reads defaults, nobody changes them
    split: Annotated[
        list[BatchSplit], typer.Option(help="Whose test pairs, or all; may be given again.")
    ] = [BatchSplit.ALL],  # noqa: B006
    synchronizer: Annotated[
        list[str], typer.Option(help="Multi-way method; may be given again.")
    ] = [],  # noqa: B006
    pairwise_only: Annotated[
        bool, typer.Option("--pairwise-only", help="Make no maps of the pairs.")
    ] = False,
    pairs: Annotated[
        PairChoice,
        typer.Option(
            help="The balanced choice of 'nss pairs' (of a bag: what it asks for), or all that "
            "overlap enough."
        ),
    ] = PairChoice.SELECTED,
    training: Annotated[
        str,
        typer.Option(help="What the methods were trained on, for the tables, e.g. same_stage."),
    ] = "",
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of everything random.")] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Processes; 0: one per core, or all of the Ray cluster."),
    ] = None,
    engine: EngineOption = Engine.LOCAL,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006
    form: FormatOption = TableFormat.RICH,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Run registration methods over the pairs of a dataset or bag, and multi-way methods after.

    Writes logs that 'nss score', 'nss compare' and 'nss report' read like those of 'nss map', and
    prints their tables. The same command goes on after an interruption; further methods, splits
    and synchronizers may be added to the same folder. The same pair has the same answer here and
    in the ROS graph.
    """
    overrides = list(set_)
    overrides += [f"registration.seed={seed}"] if seed is not None else []
    settings = load_config(config, overrides)
    own = settings.registration
    synchronizers = synchronizer or [settings.pose_graph.synchronizer]
    choice = Choice(
        methods=method or [own.method],
        splits=split,
        synchronizers=[] if pairwise_only else synchronizers,
        pairs=pairs,
        training=training,
    )
    force = Workforce(own.workers if workers is None else workers, engine, own.memory_limit)
    source = open_source(dataset)
    begin = time.monotonic()
    with progress_bar(quiet=json) as progress:
        tasks: dict[str, TaskID] = {}

        def report(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total)
            progress.update(tasks[name], completed=done, total=total)

        result = run_benchmark(source, output, choice, settings, force, report)
        scores = []
        for score in run(_score, result.logs, force.here):
            scores.append(score)
            report("scores", len(scores), len(result.logs))
    seconds = time.monotonic() - begin
    if json:
        _print_json(result, scores, seconds)
    else:
        _print(result, scores, form)
        Console(stderr=True).print(f"{seconds:.0f} s. Results: {output}", highlight=False)
    if result.problems:
        raise RunError(" ".join(result.problems))


def _score(log: RunLog) -> LogScore:
    return summarize(evaluate(with_source_points(read_log(log.path))), Bootstrap(0))


def _print_json(result: BatchResult, scores: list[LogScore], seconds: float) -> None:
    logs = [asdict(log) | {"path": str(log.path)} for log in result.logs]
    print_json(
        {
            "logs": [
                log | {"score": asdict(score)} for log, score in zip(logs, scores, strict=True)
            ],
            "timings": [asdict(timing) for timing in result.timings],
            "problems": list(result.problems),
            "seconds": seconds,
        }
    )


def _print(result: BatchResult, scores: list[LogScore], form: TableFormat) -> None:
    # The pairs of a split and method are the same in the logs of all synchronizers.
    first = {
        (log.split, log.method): score
        for log, score in reversed(list(zip(result.logs, scores, strict=True)))
    }
    runs = dict.fromkeys((log.split, log.method) for log in result.logs)
    pairwise = [first[run] for run in runs]
    tables = [pairwise_table(pairwise)] if pairwise else []
    if any(log.synchronizer for log in result.logs):
        tables.append(multiway_table(scores))
    tables.append(_timing_table(result.timings))
    remarks = [
        f"{score.split}, {score.method}: {note}" for score in pairwise for note in notes(score)
    ]
    print_tables(tables, remarks, form)


def _timing_table(timings: tuple[Timing, ...]) -> Table:
    return Table(
        "Time",
        (
            Column("method", align=Align.LEFT),
            Column("fragments timed", form=","),
            Column("features", "s", ".3f"),
            Column("pairs", form=","),
            Column("failed", form=","),
            Column("registration", "s", ".3f"),
            Column("median", "s", ".3f"),
        ),
        tuple(
            (t.method, t.fragments, t.prepare, t.pairs, t.failed, t.register, t.median)
            for t in timings
        ),
        "Features: mean seconds of a fragment; registration: of a pair, one thread each.",
    )
