"""The pairs of a dataset: how much each overlaps, how much of it changed, how complex it is.

Pairs are of one area, within and across its stages, the earlier fragment in canonical order as
the source. Measured are those that can touch (their spheres and boxes around the true poses);
kept are those that overlap.
"""

from __future__ import annotations

import csv
import io
import itertools
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import PairConfig
from nss_ros.dataset.complexity import geometric_complexity
from nss_ros.dataset.overlap import Cloud, finite_points, overlap_of_at_least
from nss_ros.dataset.ply import read_ply
from nss_ros.errors import FormatError, InputError
from nss_ros.files import write_file
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import Transform, as_transform, relative, transform_points
from nss_ros.parallel import Engine, run

Column = NDArray[np.float64]
Mask = NDArray[np.bool_]
Report = Callable[[str, int, int], None]

# Pairs are measured in blocks of two tiles of neighbouring fragments, and a block takes a second.
# Consecutive blocks share a tile, and neighbours of neighbours: indexing a cloud takes as long as
# several pairs of it, so a process keeps those that it used last.
_TILE = 16
_KEPT = 6 * _TILE


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Pairs as columns of equal length.

    Attributes:
        source: FragmentId objects.
        target: FragmentId objects.
        overlap_ratio: share of the source's points that have a point of the target within tau.
        reverse_overlap_ratio: the same of the target's points; NaN where it was not measured.
        temporal_change: ratio in the convex hulls; NaN where they share no point.
        source_complexity: mean surface variation of the source; NaN for an empty fragment.
        target_complexity: the same of the target.
        selected: chosen for the benchmark, see `nss_ros.dataset.selection`.

    Raises:
        InputError: the columns differ in length, a pair is of one fragment, or occurs twice (in
            any direction).
    """

    source: NDArray[np.object_]
    target: NDArray[np.object_]
    overlap_ratio: Column
    reverse_overlap_ratio: Column
    temporal_change: Column
    source_complexity: Column
    target_complexity: Column
    selected: Mask

    def __post_init__(self) -> None:
        lengths = {len(getattr(self, column.name)) for column in fields(self)}
        if len(lengths) > 1:
            raise InputError(f"The columns of a pair table differ in length: {sorted(lengths)}.")
        seen = set()
        for pair in self.pairs:
            key = frozenset((pair.source, pair.target))
            if len(key) == 1:
                raise InputError(f"The pair {pair} is of one fragment: a pair needs two.")
            if key in seen:
                raise InputError(f"The pair {pair} occurs twice: name two fragments once.")
            seen.add(key)

    def __len__(self) -> int:
        return len(self.source)

    @property
    def pairs(self) -> list[FragmentPair]:
        """Source and target of each row."""
        return [FragmentPair(*ids) for ids in zip(self.source, self.target, strict=True)]

    @property
    def same_stage(self) -> Mask:
        """Whether both fragments are of one stage, (n,)."""
        return np.array([pair.same_stage for pair in self.pairs], dtype=bool)

    @property
    def complexity(self) -> Column:
        """Mean of both fragments' complexity, (n,)."""
        return (self.source_complexity + self.target_complexity) / 2

    def take(self, rows: NDArray[np.integer] | Mask) -> PairTable:
        """Some rows, by index or by mask."""
        return PairTable(*(getattr(self, column.name)[rows] for column in fields(self)))

    def select(self, selected: Mask) -> PairTable:
        """The same pairs, others selected."""
        return replace(self, selected=np.asarray(selected, dtype=bool))


def measure_pairs(
    fragments: Iterable[Fragment] | Mapping[FragmentId, Path],
    poses: Mapping[FragmentId, Transform],
    config: PairConfig,
    workers: int = 0,
    engine: Engine = Engine.LOCAL,
    report: Report | None = None,
) -> PairTable:
    """All pairs of a dataset that overlap, in canonical order; none is selected yet.

    The result does not depend on the order of the fragments, on the workers or on the engine.

    Args:
        fragments: in memory, or the PLY file of each (on Ray: where all machines reach them).
        poses: `T_map_fragment` of every fragment, one map frame per area.
        config: distances and the least overlap.
        workers: processes; 0: one per core.
        engine: joblib's processes or Ray.
        report: called with "fragments" or "pairs", how many are done, and how many there are.

    Raises:
        InputError: a fragment occurs twice, has no pose or points that are not finite, or no area
            has two fragments.
        FormatError: a file is not valid.
    """
    clouds = _clouds(fragments)
    ids = sorted(clouds)
    transforms = [_pose(id_, poses) for id_ in ids]
    sources = [clouds[id_] for id_ in ids]
    if len({id_.area for id_ in ids}) == len(ids):
        raise InputError(
            f"There is no pair to measure: {len(ids)} fragments were given, and no area has two."
        )
    tasks = [
        _SurveyTask(str(id_), cloud, pose, config.curvature_radius)
        for id_, cloud, pose in zip(ids, sources, transforms, strict=True)
    ]
    surveys = []
    for survey in run(_survey, tasks, workers, engine):
        surveys.append(survey)
        if report:
            report("fragments", len(surveys), len(ids))
    candidates = _candidates(ids, transforms, surveys, config.overlap_distance)
    blocks = _blocks(ids, transforms, candidates)
    tables, done = [np.zeros((0, 5))], 0
    call = (os.getpid(), next(_CALLS))
    block_tasks = (_BlockTask.of(call, block, sources, transforms, config) for block in blocks)
    for block, figures in zip(blocks, run(_measure, block_tasks, workers, engine), strict=True):
        tables.append(figures)
        done += len(block)
        if report:
            report("pairs", done, len(candidates))
    _INDEXED.clear()
    return _table(ids, np.concatenate(tables), [survey.complexity for survey in surveys])


_HEADER = (
    "source",
    "target",
    "overlap_ratio",
    "reverse_overlap_ratio",
    "temporal_change",
    "source_complexity",
    "target_complexity",
    "selected",  # last, so that a line that was cut short cannot pass for a whole one
)


def write_pairs(path: Path, pairs: PairTable) -> None:
    """Write pairs as CSV with a header, numbers with all their digits.

    Raises:
        FormatError: the file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADER)
    numbers = [getattr(pairs, name).tolist() for name in _HEADER[2:-1]]
    for source, target, *figures, selected in zip(
        pairs.source, pairs.target, *numbers, pairs.selected.tolist(), strict=True
    ):
        writer.writerow([source, target, *map(repr, figures), int(selected)])
    write_file(path, text.getvalue().encode())


def read_pairs(path: Path) -> PairTable:
    """Read pairs that `write_pairs` wrote; further columns are ignored.

    Raises:
        FormatError: naming the file and the line that is not valid.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FormatError(f"Cannot read the pairs {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is not a table of pairs: it is not UTF-8 text.") from error
    rows = text.splitlines()
    header = rows[0].split(",") if rows else []
    missing = [name for name in _HEADER if name not in header]
    if missing:
        raise FormatError(f"{path} is not a table of pairs: its header lacks '{missing[0]}'.")
    columns = [header.index(name) for name in _HEADER]
    parsed = []
    for number, row in enumerate(rows[1:], start=2):
        words = row.split(",")
        if len(words) != len(header):
            raise FormatError(
                f"Line {number} of {path} has {len(words)} values instead of {len(header)}: the "
                "file is damaged; write it again with 'nss pairs'."
            )
        parsed.append(_row([words[column] for column in columns], f"line {number} of {path}"))
    try:
        return _from_rows(parsed)
    except InputError as error:
        raise FormatError(f"{path} is not valid: {error}") from error


_Row = tuple[FragmentId, FragmentId, float, float, float, float, float, bool]


def _row(words: Sequence[str], place: str) -> _Row:
    try:
        source, target = FragmentId.parse(words[0]), FragmentId.parse(words[1])
    except InputError as error:
        raise FormatError(f"An id in {place} is not valid: {error}") from error
    numbers = []
    for name, word in zip(_HEADER[2:-1], words[2:-1], strict=True):
        try:
            number = float(word)
        except ValueError:
            number = float("inf")
        if not (0 <= number <= 1 or (np.isnan(number) and name != "overlap_ratio")):
            raise FormatError(f"'{name}' in {place} must be a number from 0 to 1, not '{word}'.")
        numbers.append(number)
    if words[-1] not in ("0", "1"):
        raise FormatError(f"'selected' in {place} must be 0 or 1, not '{words[-1]}'.")
    return (source, target, *numbers, words[-1] == "1")  # type: ignore[return-value]


def _from_rows(rows: Sequence[_Row]) -> PairTable:
    source, target, *numbers, selected = zip(*rows, strict=True) if rows else [()] * len(_HEADER)
    figures = {
        name: np.array(column, dtype=np.float64)
        for name, column in zip(_HEADER[2:-1], numbers, strict=True)
    }
    return PairTable(
        source=_ids(source), target=_ids(target), selected=np.array(selected, dtype=bool), **figures
    )


def _ids(ids: Sequence[FragmentId]) -> NDArray[np.object_]:
    column = np.empty(len(ids), dtype=object)
    column[:] = ids
    return column


_Source = NDArray[np.floating] | Path


@dataclass(frozen=True, slots=True)
class _SurveyTask:
    name: str
    source: _Source
    T_map_fragment: Transform
    curvature_radius: float


@dataclass(frozen=True, slots=True)
class _Survey:
    """What decides which fragments can touch; an empty one touches none."""

    complexity: float
    radius: float
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def _survey(task: _SurveyTask) -> _Survey:
    try:
        points = finite_points(_points(task.source))
    except InputError as error:
        raise InputError(f"Fragment {task.name} cannot be measured: {error}") from error
    placed = transform_points(task.T_map_fragment, points)
    return _Survey(
        complexity=geometric_complexity(points, task.curvature_radius),
        radius=float(np.linalg.norm(points, axis=1).max(initial=-np.inf)),
        low=placed.min(axis=0, initial=np.inf),
        high=placed.max(axis=0, initial=-np.inf),
    )


@dataclass(frozen=True, slots=True)
class _BlockTask:
    """Pairs (n, 2) of some fragments, whose points and poses come along.

    `call` tells the fragments of one call of `measure_pairs` from those of all others.
    """

    call: tuple[int, int]
    pairs: NDArray[np.int64]
    sources: dict[int, _Source]
    poses: dict[int, Transform]
    least: float
    tau: float

    @classmethod
    def of(
        cls,
        call: tuple[int, int],
        pairs: NDArray[np.int64],
        sources: Sequence[_Source],
        poses: Sequence[Transform],
        config: PairConfig,
    ) -> _BlockTask:
        used = np.unique(pairs).tolist()
        return cls(
            call,
            pairs,
            {i: sources[i] for i in used},
            {i: poses[i] for i in used},
            config.least_overlap,
            config.overlap_distance,
        )


def _measure(task: _BlockTask) -> Column:
    """Rows of source, target (indices), overlap, reverse overlap and temporal change."""
    clouds = {i: _indexed((*task.call, i), source) for i, source in task.sources.items()}
    rows = []
    for i, j in task.pairs.tolist():
        T_target_source = relative(task.poses[i], task.poses[j])
        figures = overlap_of_at_least(clouds[i], clouds[j], T_target_source, task.least, task.tau)
        if figures and max(figures.overlap_ratio, figures.reverse_overlap_ratio) > 0:
            rows.append(
                (
                    i,
                    j,
                    figures.overlap_ratio,
                    figures.reverse_overlap_ratio,
                    figures.temporal_change,
                )
            )
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


_CALLS = itertools.count()
_INDEXED: OrderedDict[tuple[int, int, int], Cloud] = OrderedDict()
"""The clouds that this process used last, by call and index."""


def _indexed(key: tuple[int, int, int], source: _Source) -> Cloud:
    cloud = _INDEXED.pop(key, None) or Cloud(_points(source))
    _INDEXED[key] = cloud
    if len(_INDEXED) > _KEPT:
        _INDEXED.popitem(last=False)
    return cloud


def _points(source: _Source) -> NDArray[np.floating]:
    return read_ply(source) if isinstance(source, Path) else source


def _clouds(
    fragments: Iterable[Fragment] | Mapping[FragmentId, Path],
) -> dict[FragmentId, _Source]:
    if isinstance(fragments, Mapping):
        return dict(fragments)
    clouds: dict[FragmentId, _Source] = {}
    for fragment in fragments:
        if fragment.id in clouds:
            raise InputError(f"Fragment {fragment.id} was given twice: ids must be unique.")
        clouds[fragment.id] = fragment.points
    return clouds


def _pose(id_: FragmentId, poses: Mapping[FragmentId, Transform]) -> Transform:
    if id_ not in poses:
        raise InputError(f"Fragment {id_} has no pose: overlap needs the pose of every fragment.")
    return as_transform(poses[id_], f"The pose of {id_}")


def _candidates(
    ids: Sequence[FragmentId],
    poses: Sequence[Transform],
    surveys: Sequence[_Survey],
    tau: float,
) -> NDArray[np.int64]:
    """Pairs (n, 2) of one area whose spheres and boxes come within tau of each other."""
    areas = np.unique([id_.area for id_ in ids], return_inverse=True)[1]
    positions = np.array([pose[:3, 3] for pose in poses])
    radii = np.array([survey.radius for survey in surveys])
    low = np.array([survey.low for survey in surveys]) - tau / 2
    high = np.array([survey.high for survey in surveys]) + tau / 2
    pairs = []
    for i in range(len(ids) - 1):
        rest = slice(i + 1, None)
        distances = np.linalg.norm(positions[rest] - positions[i], axis=1)
        near = (areas[rest] == areas[i]) & (distances <= radii[i] + radii[rest] + tau)
        near &= ((low[rest] <= high[i]) & (low[i] <= high[rest])).all(axis=1)
        others = np.flatnonzero(near) + i + 1
        pairs.append(np.column_stack((np.full(len(others), i), others)))
    return np.concatenate(pairs)


def _blocks(
    ids: Sequence[FragmentId], poses: Sequence[Transform], pairs: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """The pairs (n, 2) in groups of few fragments."""
    if len(pairs) == 0:
        return []
    tiles = np.sort(_tiles(ids, poses)[pairs], axis=1)
    order = np.lexsort((tiles[:, 1], tiles[:, 0]))
    changes = np.flatnonzero(np.diff(tiles[order], axis=0).any(axis=1)) + 1
    return np.split(pairs[order], changes)


def _tiles(ids: Sequence[FragmentId], poses: Sequence[Transform]) -> NDArray[np.int64]:
    """The number of each fragment's tile: strips along x, cut along y, of one area each."""
    tiles = np.zeros(len(ids), dtype=np.int64)
    positions = np.array([pose[:2, 3] for pose in poses])
    areas = np.unique([id_.area for id_ in ids], return_inverse=True)[1]
    count = 0
    for area in range(int(areas.max()) + 1):
        members = np.flatnonzero(areas == area)
        strips = max(1, round(np.sqrt(len(members) / _TILE)))
        by_x = members[np.argsort(positions[members, 0], kind="stable")]
        for strip in np.array_split(by_x, strips):
            by_y = strip[np.argsort(positions[strip, 1], kind="stable")]
            for tile in np.array_split(by_y, -(-len(by_y) // _TILE)):
                tiles[tile] = count
                count += 1
    return tiles


def _table(ids: Sequence[FragmentId], rows: Column, complexities: Sequence[float]) -> PairTable:
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    source, target = rows[:, :2].astype(np.int64).T
    complexity = np.array(complexities)
    return PairTable(
        source=_ids([ids[i] for i in source]),
        target=_ids([ids[i] for i in target]),
        overlap_ratio=rows[:, 2].copy(),
        reverse_overlap_ratio=rows[:, 3].copy(),
        temporal_change=rows[:, 4].copy(),
        source_complexity=complexity[source],
        target_complexity=complexity[target],
        selected=np.zeros(len(rows), dtype=bool),
    )
