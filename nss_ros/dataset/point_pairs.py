"""Points that a person picked in two stages, the same corner in each: YAML or CSV.

YAML, points in metres, each in the frame of its own stage's scan:

    anchor: 3
    stages:
      1:
        - {point: [1.02, 4.51, 0.03], anchor: [11.40, 2.07, 0.05]}
        - ...

CSV with a header, one pair a line, the anchor stage in every line:

    stage,x,y,z,anchor_stage,anchor_x,anchor_y,anchor_z
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from nss_ros.errors import FormatError

_COLUMNS = ("stage", "x", "y", "z", "anchor_stage", "anchor_x", "anchor_y", "anchor_z")


@dataclass(frozen=True, slots=True)
class StagePicks:
    """The picked points of one stage.

    Attributes:
        points: (n, 3) metres, frame of the stage.
        anchors: (n, 3) the same points in the frame of the anchor stage.
    """

    points: NDArray[np.float64]
    anchors: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PointPairs:
    """All picked points.

    Attributes:
        anchor: the stage towards which the others are aligned.
        stages: the points of each other stage.
        file: where they were read from, for messages.
    """

    anchor: int
    stages: dict[int, StagePicks]
    file: str


def read_point_pairs(path: Path) -> PointPairs:
    """Read picked points; the ending, `.csv` or another, decides the format.

    Raises:
        FormatError: the file cannot be read or is not of the format above.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FormatError(f"Cannot read the picked points {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is not a text file.") from error
    anchor, rows = _csv(text, path) if path.suffix.lower() == ".csv" else _yaml(text, path)
    stages: dict[int, list[list[float]]] = {}
    for stage, numbers in rows:
        stages.setdefault(stage, []).append(numbers)
    if anchor in stages:
        raise FormatError(
            f"{path} picks points of stage {anchor}, which is the anchor: leave them out."
        )
    if not stages:
        raise FormatError(f"{path} holds no picked points: give three or more for each stage.")
    return PointPairs(
        anchor=anchor,
        stages={
            stage: StagePicks(np.array(numbers)[:, :3], np.array(numbers)[:, 3:])
            for stage, numbers in sorted(stages.items())
        },
        file=str(path),
    )


_Rows = list[tuple[int, list[float]]]


def _yaml(text: str, path: Path) -> tuple[int, _Rows]:
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FormatError(f"{path} is not valid YAML: {' '.join(str(error).split())}.") from error
    if not isinstance(data, dict) or not isinstance(data.get("stages"), dict):
        raise FormatError(
            f"{path} does not hold picked points: expected 'anchor' and, under 'stages', a list "
            "of {point: [x, y, z], anchor: [x, y, z]} for each stage."
        )
    anchor = _stage(data.get("anchor"), f"'anchor' of {path}")
    rows: _Rows = []
    for name, picks in data["stages"].items():
        stage = _stage(name, f"A key of 'stages' of {path}")
        if not isinstance(picks, list):
            raise FormatError(f"Stage {stage} of {path} must hold a list of picked points.")
        for number, pick in enumerate(picks, start=1):
            place = f"Pick {number} of stage {stage} of {path}"
            if not isinstance(pick, dict) or set(pick) != {"point", "anchor"}:
                raise FormatError(f"{place} must be {{point: [x, y, z], anchor: [x, y, z]}}.")
            rows.append(
                (stage, [*_numbers(pick["point"], place), *_numbers(pick["anchor"], place)])
            )
    return anchor, rows


def _csv(text: str, path: Path) -> tuple[int, _Rows]:
    lines = list(csv.reader(text.splitlines()))
    if not lines or tuple(word.strip() for word in lines[0]) != _COLUMNS:
        raise FormatError(f"{path} must begin with the line {','.join(_COLUMNS)}.")
    rows: _Rows = []
    anchors = set()
    for number, words in enumerate(lines[1:], start=2):
        if not words:
            continue
        place = f"Line {number} of {path}"
        if len(words) != len(_COLUMNS):
            raise FormatError(f"{place} must have {len(_COLUMNS)} columns, not {len(words)}.")
        rows.append(
            (
                _stage(words[0], f"'stage' in line {number} of {path}"),
                [*_numbers(words[1:4], place), *_numbers(words[5:8], place)],
            )
        )
        anchors.add(_stage(words[4], f"'anchor_stage' in line {number} of {path}"))
    if len(anchors) > 1:
        raise FormatError(
            f"{path} names {len(anchors)} anchor stages ({', '.join(map(str, sorted(anchors)))}): "
            "align all stages towards one."
        )
    return (anchors.pop() if anchors else 0), rows


def _stage(value: Any, place: str) -> int:
    text = str(value).strip()
    if isinstance(value, bool) or not text.isdecimal():
        raise FormatError(f"{place} must be the number of a stage, not {value!r}.")
    return int(text)


def _numbers(values: Any, place: str) -> Sequence[float]:
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers):
        raise FormatError(f"{place} must hold points of three finite numbers x, y, z.")
    return numbers
