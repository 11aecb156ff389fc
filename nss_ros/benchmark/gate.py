"""Gates for continuous integration: `recall_different_stage < 0.9` fails a run.

A gate is `NAME OPERATOR NUMBER`, with one of < <= > >= == !=, and the run fails if it is true.
Shares (recall, coverage, F1, probabilities) are compared as 0..1, so 0.9 and 90 % are the same.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from math import isnan

from nss_ros.benchmark.headline import FIGURES
from nss_ros.errors import InputError

DELTA = "delta_"
"""Prefix of the difference to the baseline, in a comparison."""
COUNTS = ("unanswered", "failed", "components")
"""What can be counted of one log: pairs without an answer, failures, components of the map."""

_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_GATE = re.compile(
    r"\s*(?P<name>\w+)\s*(?P<operator><=|>=|==|!=|<|>)"
    r"\s*(?P<number>[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?)\s*(?P<percent>%?)\s*",
    re.ASCII | re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class Gate:
    """A condition under which a run fails.

    Attributes:
        text: as it was written.
        name: of the figure.
        operator: one of < <= > >= == !=.
        limit: 0..1 for shares, else in the figure's unit.
        unit: of the figure, with a space before it; empty for 0..1 and counts.
    """

    text: str
    name: str
    operator: str
    limit: float
    unit: str

    def fails(self, values: Mapping[str, float], run: str) -> bool:
        """Whether the run fails.

        Args:
            values: of the run's figures by name, in their own units.
            run: what the run is called, for the error message.

        Raises:
            InputError: the run has no such figure.
        """
        value = values.get(self.name, float("nan"))
        if isnan(value):
            raise InputError(
                f"The gate '{self.text}' cannot be judged: {run} has no {self.name}, for want of "
                "such pairs, points, answers or a map."
            )
        if self.unit == " %":
            value /= 100
        return _OPERATORS[self.operator](value, self.limit)


def parse_gate(text: str, names: Collection[str]) -> Gate:
    """The gate that is written as `text`.

    Args:
        text: for example `recall_all < 0.9`, `recall_all < 90 %` or `global_rmse >= 0.3`.
        names: the figures that there are.

    Raises:
        InputError: it is not a gate, there is no such figure, or a share is beyond 1.
    """
    match = _GATE.fullmatch(text)
    if match is None:
        raise InputError(
            f"'{text}' is not a gate: write NAME OPERATOR NUMBER with one of "
            f"{' '.join(_OPERATORS)}, for example 'recall_different_stage < 0.9'."
        )
    name, limit = match["name"], float(match["number"])
    if name not in names:
        raise InputError(
            f"The gate '{text}' names no figure that there is; the figures are "
            f"{', '.join(sorted(names))}."
        )
    figure = FIGURES.get(name.removeprefix(DELTA))
    share = figure is not None and figure.is_share
    unit = f" {figure.unit}" if figure is not None and figure.unit else ""
    if match["percent"]:
        if not share:
            raise InputError(f"The gate '{text}' has a percent sign, but {name} is no share.")
        limit /= 100
    if share and abs(limit) > 1:
        raise InputError(
            f"The gate '{text}' compares {name}, a share of 0 to 1, with {limit:g}: write "
            f"{limit / 100:g} or {limit:g} %."
        )
    return Gate(text.strip(), name, match["operator"], limit, unit)
