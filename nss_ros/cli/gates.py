"""`--fail-if`: gates that make a command fail in continuous integration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from nss_ros.benchmark.gate import Gate

FAILED = 3
"""Exit status if a gate holds; 1 is an error, 2 a usage error."""

FailIfOption = Annotated[
    list[str],
    typer.Option(
        metavar="GATE",
        help="Exit with 3 if this holds, for example 'recall_different_stage < 0.9'; may be given "
        "again. An unknown name lists all.",
    ),
]


def exit_on_failure(gates: Sequence[Gate], runs: Mapping[str, Mapping[str, float]]) -> None:
    """Say which gates hold for which run, on standard error, and exit with 3 if one does.

    Args:
        gates: conditions under which a run fails.
        runs: values of figures by name, by what the run is called.

    Raises:
        InputError: a run lacks a figure.
    """
    failures = [
        (gate, name, values[gate.name])
        for gate in gates
        for name, values in runs.items()
        if gate.fails(values, name)
    ]
    console = Console(stderr=True)
    for gate, name, value in failures:
        sentence = f"{name}: {gate.text} ({gate.name} is {value:.4g}{gate.unit})"
        console.print(f"[red]failed:[/red] {escape(sentence)}", soft_wrap=True, highlight=False)
    if failures:
        raise typer.Exit(FAILED)
