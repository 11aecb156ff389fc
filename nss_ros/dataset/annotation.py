"""The pairwise annotations of the NSS release: JSON, one list of pairs per set of a split.

    [{"source": "Bldg1_Stage1_Spot3.ply", "target": "Bldg1_Stage2_Spot14.ply",
      "tsfm": [4 rows of 4 numbers], "overlap": 0.41, "temporal_change": 0.12,
      "same_stage": false}, ...]

`tsfm` is `T_target_source`, which maps the source's points onto the target, in metres. Names and
direction are those of an edge in the pose graphs of 2024, as the official evaluator documents
them (GradientSpaces/nss-challenge, evaluate_registration.py: "4x4 transformation matrix of the
relative pose from the source to the target", "overlap", "temporal_change", "same_stage"); those
of 2025 (`relative_transform`, `overlap_ratio`, `source_id`, `target_id`) are read, too. How the
release's own pairwise files name the two point clouds is not documented where we could read it:
that `source` and `target` hold their names is our reading. Whether two fragments are of one stage
follows from their names, so that `same_stage` is written but not believed.

We add `reverse_overlap`, `source_complexity` and `target_complexity`, which other readers ignore
and which may be missing.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.dataset.pairs import PairTable
from nss_ros.errors import FormatError, InputError
from nss_ros.files import write_file
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, is_transform

_SOURCE, _TARGET = ("source", "source_id"), ("target", "target_id")
_TRANSFORM = ("tsfm", "relative_transform")
# Names in files, ours first, of each ratio of a pair.
_RATIOS = {
    "overlap_ratio": ("overlap", "overlap_ratio"),
    "temporal_change": ("temporal_change",),
    "reverse_overlap_ratio": ("reverse_overlap",),
    "source_complexity": ("source_complexity",),
    "target_complexity": ("target_complexity",),
}


@dataclass(frozen=True, slots=True)
class PairAnnotation:
    """What the release says of a pair.

    Attributes:
        pair: source and target.
        T_target_source: ground truth, (4, 4), metres.
        overlap_ratio: of the source, 0 to 1.
        temporal_change: ratio, 0 to 1; NaN where it is not known.
        reverse_overlap_ratio: of the target; NaN where it is not known.
        source_complexity: mean surface variation; NaN where it is not known.
        target_complexity: likewise.
    """

    pair: FragmentPair
    T_target_source: Transform
    overlap_ratio: float
    temporal_change: float = math.nan
    reverse_overlap_ratio: float = math.nan
    source_complexity: float = math.nan
    target_complexity: float = math.nan


def write_annotations(path: Path, annotations: Iterable[PairAnnotation]) -> None:
    """Write the pairs of a set, numbers with all their digits; what is not known is left out.

    Raises:
        FormatError: the file cannot be written.
    """
    lines = [json.dumps(_fields(each)) for each in annotations]
    write_file(path, ("[\n" + ",\n".join(lines) + "\n]\n").encode())


def read_annotations(path: Path) -> list[PairAnnotation]:
    """Read the pairs of a set, in the order of the file.

    Raises:
        FormatError: the file cannot be read, is not JSON, or a pair is not valid; names it.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise FormatError(f"Cannot read the annotations {path}: {error.strerror}.") from error
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"{path} is not valid JSON, it may be truncated: {error}; copy the file again."
        ) from error
    if not isinstance(content, list):
        raise FormatError(f"{path} is not a list of annotated pairs, as the NSS release has it.")
    return [_annotation(data, f"pair {i} of {path}") for i, data in enumerate(content, start=1)]


def pair_table(annotations: Sequence[PairAnnotation], selected: bool = True) -> PairTable:
    """The pairs as a table.

    Args:
        annotations: each two fragments once.
        selected: what the table says of all of them.

    Raises:
        InputError: a pair occurs twice, or is of one fragment.
    """
    source, target = (np.empty(len(annotations), dtype=object) for _ in range(2))
    source[:] = [each.pair.source for each in annotations]
    target[:] = [each.pair.target for each in annotations]

    def column(name: str) -> NDArray[np.float64]:
        return np.array([getattr(each, name) for each in annotations], dtype=np.float64)

    return PairTable(
        source,
        target,
        column("overlap_ratio"),
        column("reverse_overlap_ratio"),
        column("temporal_change"),
        column("source_complexity"),
        column("target_complexity"),
        np.full(len(annotations), selected),
    )


def _fields(annotation: PairAnnotation) -> dict[str, Any]:
    pair = annotation.pair
    fields: dict[str, Any] = {
        "source": f"{pair.source}.ply",
        "target": f"{pair.target}.ply",
        "tsfm": annotation.T_target_source.tolist(),
    }
    ratios = {names[0]: getattr(annotation, name) for name, names in _RATIOS.items()}
    known = {name: float(ratio) for name, ratio in ratios.items() if math.isfinite(ratio)}
    return fields | {"same_stage": pair.same_stage} | known


def _annotation(data: Any, place: str) -> PairAnnotation:
    if not isinstance(data, dict):
        raise FormatError(f"A pair in a file of annotations is not an object: {place}.")
    pair = FragmentPair(_id(data, _SOURCE, place), _id(data, _TARGET, place))
    if pair.source == pair.target:
        raise FormatError(f"The source and the target of {place} are one fragment, {pair.source}.")
    transform = _matrix(_first(data, _TRANSFORM))
    if transform is None:
        raise FormatError(
            f"'tsfm' of {place} is not rigid: expected a 4x4 matrix of a finite rotation and "
            "translation with the last row 0 0 0 1."
        )
    ratios = {name: _ratio(data, names, place) for name, names in _RATIOS.items()}
    if math.isnan(ratios["overlap_ratio"]):
        raise FormatError(f"There is no 'overlap' in {place}.")
    return PairAnnotation(pair, transform, **ratios)


def _first(data: dict[str, Any], names: Sequence[str]) -> Any:
    return next((data[name] for name in names if name in data), None)


def _id(data: dict[str, Any], names: Sequence[str], place: str) -> FragmentId:
    value = _first(data, names)
    try:
        return fragment_of(str(value))
    except InputError as error:
        raise FormatError(f"'{names[0]}' of {place} is not usable: {error}") from error


def fragment_of(name: str) -> FragmentId:
    """The fragment that a point cloud's file name tells, `<id>.ply` or `<id>.450.ply`.

    The official tool `pan_to_pcd.py` puts its cut in centimetres between id and ending.

    Raises:
        InputError: it tells none.
    """
    stem = name.removesuffix(".ply")
    head, _, tail = stem.rpartition(".")
    return FragmentId.parse(head if tail.isdecimal() and "_Spot" in head else stem)


def _matrix(value: Any) -> Transform | None:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return matrix if is_transform(matrix) else None


def _ratio(data: dict[str, Any], names: Sequence[str], place: str) -> float:
    value = _first(data, names)
    if value is None:
        return math.nan
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not 0 <= value <= 1:
        raise FormatError(f"'{names[0]}' of {place} must be a number from 0 to 1, not {value!r}.")
    return float(value)
