"""`nss score`: logs against their ground truth, or challenge files against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from nss_ros.bag import read_log, with_source_points
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.challenge import ChallengeMetrics, ChallengeScore, score_challenge
from nss_ros.benchmark.clouds import clouds_in
from nss_ros.benchmark.evaluation import evaluate, joined
from nss_ros.benchmark.gate import COUNTS, parse_gate
from nss_ros.benchmark.headline import FIGURES
from nss_ros.benchmark.metrics import MAX_RRE, MAX_RTE_CHALLENGE
from nss_ros.benchmark.run import Run, read_run
from nss_ros.benchmark.score import LogScore, summarize
from nss_ros.benchmark.table import (
    OFFICIAL_NAMES,
    challenge_tables,
    log_tables,
    notes,
    run_tables,
)
from nss_ros.cli.bootstrap_options import ByFragmentOption, ResamplingsOption, SeedOption
from nss_ros.cli.figure_options import (
    EndingOption,
    FiguresOption,
    WorstOption,
    check_ending,
    write_figures,
)
from nss_ros.cli.gates import FailIfOption, exit_on_failure
from nss_ros.cli.output import print_json
from nss_ros.cli.table_format import (
    FormatOption,
    TableFormat,
    TableOption,
    chosen_tables,
    print_tables,
)
from nss_ros.dataset.challenge import read_graphs
from nss_ros.errors import InputError

_HIDDEN = ("intervals", "reliability")


def score(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...", help="Log folders, as written by 'nss map'."),
    ] = None,
    target: Annotated[
        Path | None, typer.Option(help="Challenge file with the ground truth, instead of LOG.")
    ] = None,
    prediction: Annotated[
        Path | None, typer.Option(help="Challenge file with the prediction.")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="PLY files of the challenge files' nodes; for RMSE."),
    ] = None,
    translation_threshold: Annotated[
        float, typer.Option(min=0, help="Challenge files: largest RTE of a success, metres.")
    ] = MAX_RTE_CHALLENGE,
    rotation_threshold: Annotated[
        float, typer.Option(min=0, help="Challenge files: largest RRE of a success, degrees.")
    ] = MAX_RRE,
    together: Annotated[
        bool, typer.Option("--together", help="Take all logs as one result set.")
    ] = False,
    form: FormatOption = TableFormat.RICH,
    table: TableOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    fail_if: FailIfOption = [],  # noqa: B006
    resamplings: ResamplingsOption = 1000,
    seed: SeedOption = 0,
    by_fragment: ByFragmentOption = False,
    figures: FiguresOption = None,
    ending: EndingOption = "png",
    worst: WorstOption = 8,
    json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
) -> None:
    """Score logs, or a challenge prediction with the challenge's official definitions.

    A log is scored against the ground truth it carries, pairwise and as a map, at 10 degrees with
    0.2 m (the paper's) and with 0.1 m (the challenge's). Several logs stand side by side, as in
    the paper's tables. More tables with --table: 'intervals' (bootstrap intervals of all headline
    figures), 'reliability'.

    Exits with 3 if a gate of --fail-if holds for a log, with 1 on any error.
    """
    check_ending(ending)
    if logs and target is None and prediction is None:
        if points is not None:
            raise InputError("--points belongs to --target and --prediction: a LOG has its own.")
        gates = [parse_gate(text, (*FIGURES, *COUNTS)) for text in fail_if]
        bootstrap = Bootstrap(resamplings, seed, by_fragment=by_fragment)
        # Figures take the whole logs; without them only what was measured stays in memory.
        runs = [read_run(log, bootstrap) for log in logs] if figures is not None else []
        scores = _scores(logs, runs, together, bootstrap)
        if json:
            print_json(asdict(scores[0]) if len(scores) == 1 else {"logs": [*map(asdict, scores)]})
        else:
            _print_scores(scores, table, form)
        if figures is not None:
            for path in write_figures(runs, worst, figures, ending):
                Console(stderr=True).print(f"Wrote {path}", soft_wrap=True, highlight=False)
        exit_on_failure(gates, {each.log: _values(each) for each in scores})
        return
    if logs or target is None or prediction is None:
        raise InputError("Give either a LOG, or both --target and --prediction.")
    if fail_if or together or figures is not None:
        raise InputError(
            "--fail-if, --together and --figures belong to logs, not to challenge files."
        )
    official = score_challenge(
        read_graphs(target),
        read_graphs(prediction),
        clouds_in(points) if points is not None else None,
        translation_threshold,
        rotation_threshold,
    )
    if json:
        print_json(_official(official))
    else:
        print_tables(chosen_tables(challenge_tables(official), table), official.notes, form)


def _scores(
    logs: Sequence[Path], runs: Sequence[Run], together: bool, bootstrap: Bootstrap
) -> list[LogScore]:
    if runs:
        evaluations = [run.evaluation or evaluate(run.log) for run in runs]
    else:
        # One after the other: the point clouds of a log go before those of the next come.
        evaluations = [evaluate(with_source_points(read_log(log))) for log in logs]
    if together:
        evaluations = [joined(evaluations)]
    return [summarize(evaluation, bootstrap) for evaluation in evaluations]


def _print_scores(scores: Sequence[LogScore], table: Sequence[str], form: TableFormat) -> None:
    if len(scores) == 1:
        tables = chosen_tables(log_tables(scores[0]), table, _HIDDEN)
        print_tables(tables, notes(scores[0]), form)
        return
    remarks = [f"{each.log}: {note}" for each in scores for note in notes(each)]
    print_tables(chosen_tables(run_tables(scores), table), remarks, form)


def _values(score: LogScore) -> dict[str, float]:
    """What gates can name, of one log."""
    values = {name: figure.value for name, figure in score.headline.items()}
    values |= {"unanswered": score.pairs - score.answered, "failed": score.failed}
    if score.overall.map is not None:
        values["components"] = score.overall.map.components
    return values


def _official(score: ChallengeScore) -> dict[str, Any]:
    """With the official evaluator's names, so that outputs can be compared as they are."""
    return {
        "scenes": {name: _named(subsets) for name, subsets in score.scenes.items()},
        "overall": _named(score.overall),
        "notes": list(score.notes),
    }


def _named(subsets: Mapping[str, ChallengeMetrics]) -> dict[str, dict[str, float]]:
    return {
        subset: {
            name: getattr(metrics, attribute)
            for attribute, (name, _) in OFFICIAL_NAMES.items()
            if getattr(metrics, attribute) is not None
        }
        for subset, metrics in subsets.items()
    }
