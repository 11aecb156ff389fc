"""Registration of the pairs that the journal lacks, on one machine or on a Ray cluster.

Workers are given fragments and ids, nothing of the dataset. They share fragments and features
through a folder and register as the ROS node's workers do, with the same seeds, so a pair has the
same answer here and there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

from nss_ros.batch.journal import Journal
from nss_ros.config import RegistrationConfig
from nss_ros.errors import InputError, WorkerDiedError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, clean_points
from nss_ros.parallel import Engine, stream
from nss_ros.registration.feature_store import (
    FeatureStore,
    feature_file,
    fragment_file,
    store_fragment,
)
from nss_ros.registration.method import load_method
from nss_ros.registration.relative_transform import RelativeTransform, worker_died

Report = Callable[[str, int, int], None]
_MOST_ATTEMPTS = 2


class Fragments(Protocol):
    """Where fragments are read from."""

    def fragment(self, fragment: FragmentId, /) -> Fragment:
        """A fragment's points."""


@dataclass(frozen=True, slots=True)
class Workforce:
    """Who computes.

    Attributes:
        workers: processes; 0: one per core, or all that the Ray cluster has.
        engine: this machine, or Ray.
        memory_limit: MiB of features that each process keeps in memory.
    """

    workers: int = 0
    engine: Engine = Engine.LOCAL
    memory_limit: int = 1024

    @property
    def here(self) -> int:
        """Processes of this machine for what does not go to Ray; 0: one per core."""
        return self.workers if self.engine is Engine.LOCAL else 0


@dataclass(frozen=True, slots=True)
class _Job:
    """What a worker needs for any pair; hashable, so that it sets itself up once."""

    config: str
    fragments: str
    features: str
    memory_limit: int


@dataclass(frozen=True, slots=True)
class _Task:
    """A pair to register, or with no pair a fragment to prepare."""

    job: _Job
    fragment: FragmentId
    pair: FragmentPair | None = None


@dataclass(frozen=True, slots=True)
class _Answer:
    task: _Task
    seconds: float = float("nan")
    result: RelativeTransform | None = None


def register_missing(
    source: Fragments,
    pairs: Sequence[FragmentPair],
    config: RegistrationConfig,
    journal: Journal,
    work: Path,
    force: Workforce,
    report: Report,
) -> None:
    """Register the pairs that the journal has no answer for; answers land in it as they come.

    Pairs whose worker died in an earlier session are tried again.

    Args:
        source: whose fragments are read.
        pairs: all pairs, such that neighbours share fragments.
        config: method and settings.
        journal: of all methods.
        work: folder for fragments and features; on Ray where all machines reach it.
        force: who computes.
        report: called with "fragments" or "pairs", how many are done, and how many there are.

    Raises:
        MethodError: the method is not installed or lacks something.
        FormatError: a fragment cannot be read.
        InputError: Ray was asked for and is not there, or does not reach the folder.
    """
    load_method(config)
    known = journal.of(config.method)
    missing = [pair for pair in pairs if pair not in known or not known[pair].final]
    count = len(pairs) - len(missing)
    report("pairs", count, len(pairs))
    if not missing:
        return
    fragments = work.absolute() / "fragments"
    features = work.absolute() / "features" / config.method.replace("/", "_")
    for folder in (fragments, features):
        folder.mkdir(parents=True, exist_ok=True)
    job = _Job(config.model_dump_json(), str(fragments), str(features), force.memory_limit)
    _prepare(source, missing, config, journal, job, force, report)
    for answer in _answers([_Task(job, pair.source, pair) for pair in missing], force):
        pair = _pair(answer.task)
        if answer.result is not None or pair not in known:
            journal.add(config.method, answer.result or worker_died(pair, config.method))
        count += 1
        report("pairs", count, len(pairs))


def _prepare(
    source: Fragments,
    pairs: Iterable[FragmentPair],
    config: RegistrationConfig,
    journal: Journal,
    job: _Job,
    force: Workforce,
    report: Report,
) -> None:
    """Have the features of all fragments computed, in the order in which pairs need them."""
    ids = list(dict.fromkeys(id_ for pair in pairs for id_ in (pair.source, pair.target)))
    lacking = [id_ for id_ in ids if not feature_file(Path(job.features), id_).exists()]
    count = len(ids) - len(lacking)
    report("fragments", count, len(ids))

    def tasks() -> Iterator[_Task]:
        for id_ in lacking:
            _store(source, id_, Path(job.fragments), config.voxel_size)
            yield _Task(job, id_)

    # What kills its process here is tried again with each of its pairs, and reported there.
    for answer in _answers(tasks(), force):
        if not math.isnan(answer.seconds):
            journal.add_preparation(config.method, answer.task.fragment, answer.seconds)
        count += 1
        report("fragments", count, len(ids))


def _store(source: Fragments, id_: FragmentId, folder: Path, voxel_size: float) -> None:
    if not fragment_file(folder, id_).exists():
        fragment = source.fragment(id_)
        # As it would come out of a message.
        points = clean_points(fragment.points)
        store_fragment(folder, Fragment(id_, points, fragment.gravity_aligned), voxel_size)


def _answers(tasks: Iterable[_Task], force: Workforce) -> Iterator[_Answer]:
    """An answer to every task as it comes; without a result where a worker died twice."""
    rest = iter(tasks)
    while True:
        open_: dict[tuple[FragmentId, FragmentPair | None], _Task] = {}
        try:
            for answer in stream(_run, _noted(rest, open_), force.workers, force.engine):
                del open_[answer.task.fragment, answer.task.pair]
                yield answer
        except WorkerDiedError:
            # One of those in reach did it: each once more, in a process of its own.
            for task in list(open_.values()):
                yield _alone(task)
            continue
        return


def _noted(
    tasks: Iterator[_Task], open_: dict[tuple[FragmentId, FragmentPair | None], _Task]
) -> Iterator[_Task]:
    for task in tasks:
        open_[task.fragment, task.pair] = task
        yield task


def _alone(task: _Task) -> _Answer:
    for _ in range(_MOST_ATTEMPTS):
        try:
            return next(stream(_run, [task], workers=1))
        except WorkerDiedError:
            continue
    return _Answer(task)


def _run(task: _Task) -> _Answer:
    """In a worker."""
    if not Path(task.job.fragments).is_dir():
        raise InputError(
            f"A worker does not see the folder {task.job.fragments}: put the results, with -o, on "
            "a disk that all machines of the Ray cluster share."
        )
    config, store = _store_of(task.job)
    if task.pair is None:
        return _Answer(task, seconds=store.prepare(task.fragment).seconds)
    return _Answer(task, result=store.register(task.pair, config))


@lru_cache(maxsize=1)
def _store_of(job: _Job) -> tuple[RegistrationConfig, FeatureStore]:
    config = RegistrationConfig.model_validate_json(job.config)
    method = load_method(config)
    folders = Path(job.fragments), Path(job.features)
    return config, FeatureStore(method, *folders, job.memory_limit << 20, config.find_standpoints)


def _pair(task: _Task) -> FragmentPair:
    assert task.pair is not None
    return task.pair
