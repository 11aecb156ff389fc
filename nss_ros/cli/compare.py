"""`nss compare`: runs against a baseline."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from nss_ros.bag import read_log, with_source_points
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.comparison import Comparison, PairChanges, compare
from nss_ros.benchmark.comparison_table import comparison_tables
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.benchmark.gate import DELTA, parse_gate
from nss_ros.benchmark.headline import FIGURES
from nss_ros.cli.bootstrap_options import ByFragmentOption, ResamplingsOption, SeedOption
from nss_ros.cli.gates import FailIfOption, exit_on_failure
from nss_ros.cli.output import print_json
from nss_ros.cli.table_format import (
    FormatOption,
    TableFormat,
    TableOption,
    chosen_tables,
    print_tables,
)

_HIDDEN = ("intervals",)


def compare_logs(
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="Log to compare with.")],
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs that are judged.")],
    form: FormatOption = TableFormat.RICH,
    table: TableOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    fail_if: FailIfOption = [],  # noqa: B006
    resamplings: ResamplingsOption = 1000,
    seed: SeedOption = 0,
    by_fragment: ByFragmentOption = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print as JSON, with the pairs won and lost.")
    ] = False,
) -> None:
    """Compare logs with a baseline: differences with paired bootstrap p-values, pairs won and lost.

    Compared is what both logs were to do: edges that are in the ground truth of both and that both
    were asked for. Gates of --fail-if judge each LOG by the figures of that comparison; with the
    prefix 'delta_' they judge the difference to the baseline, for example
    'delta_recall_all < -0.02'.

    Exits with 3 if a gate holds for a log, with 1 on any error.
    """
    names = (*FIGURES, *(f"{DELTA}{name}" for name in FIGURES))
    gates = [parse_gate(text, names) for text in fail_if]
    bootstrap = Bootstrap(resamplings, seed, by_fragment=by_fragment)
    first = evaluate(with_source_points(read_log(baseline)))
    comparisons = [
        compare(first, evaluate(with_source_points(read_log(log))), bootstrap) for log in logs
    ]
    if json:
        print_json({"comparisons": [_as_json(each) for each in comparisons]})
    else:
        for each in comparisons:
            print_tables(chosen_tables(comparison_tables(each), table, _HIDDEN), each.notes, form)
    exit_on_failure(gates, {each.log: _values(each) for each in comparisons})


def _values(comparison: Comparison) -> dict[str, float]:
    """What gates can name."""
    values = {name: each.value for name, each in comparison.differences.items()}
    deltas = {f"{DELTA}{name}": d.difference for name, d in comparison.differences.items()}
    return values | deltas


def _as_json(comparison: Comparison) -> dict[str, Any]:
    return asdict(comparison) | {
        way: None if changes is None else _pairs(changes)
        for way, changes in (
            ("pairwise", comparison.pairwise),
            ("multiway", comparison.multiway),
        )
    }


def _pairs(changes: PairChanges) -> dict[str, list[list[str]]]:
    """Pairs as [source, target]."""
    return {
        "won": [[str(pair.source), str(pair.target)] for pair in changes.won],
        "lost": [[str(pair.source), str(pair.target)] for pair in changes.lost],
    }
