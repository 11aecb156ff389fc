"""Registration of many pairs by worker processes that share features through a folder.

Each worker keeps what it used last in memory, up to a limit; everything else waits on disk.
A worker that dies takes one pair with it, not the run.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.registration.feature_store import (
    FeatureStore,
    Preparation,
    forget_features,
    fragment_file,
    store_fragment,
)
from nss_ros.registration.method import load_method
from nss_ros.registration.relative_transform import RelativeTransform, worker_died
from nss_ros.worker_process import stop_now, worker_pool

_PREFIX = "nss_registration_"
_MOST_ATTEMPTS = 2


@dataclass(slots=True)
class _Task:
    """A pair to register, or with no pair a fragment to prepare."""

    fragment: FragmentId
    pair: FragmentPair | None = None
    attempts: int = 0


class RegistrationPool:
    """Worker processes that prepare fragments and register pairs. Used by one thread.

    Args:
        config: method and settings.
        workers: processes; 0 means one per processor core.
        memory_limit: MiB of features that each worker keeps in memory.
    """

    def __init__(self, config: RegistrationConfig, workers: int = 0, memory_limit: int = 1024):
        _sweep()
        self._config = config
        self._workers = workers or os.cpu_count() or 1
        self._memory_limit = memory_limit
        self._directory = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}_"))
        self._executor = self._start()
        self._waiting: deque[_Task] = deque()
        self._running: dict[Future[RelativeTransform | Preparation], _Task] = {}
        self._prepared: list[Preparation] = []
        self._last_source: FragmentId | None = None

    def add_fragment(self, fragment: Fragment) -> Path:
        """Take a fragment in, voxelised, and have its features computed; the file that holds it."""
        store_fragment(self._directory, fragment, self._config.voxel_size)
        self._waiting.append(_Task(fragment.id))
        return fragment_file(self._directory, fragment.id)

    def submit(self, pair: FragmentPair) -> None:
        """Have a pair registered whose fragments were added before."""
        self._waiting.append(_Task(pair.source, pair))

    def reconfigure(self, config: RegistrationConfig, workers: int, memory_limit: int) -> None:
        """Use other settings for the pairs that are not running yet; features are made anew.

        Fragments that came before stay voxelised as they are: `voxel_size` counts for later ones.
        """
        self._config, self._workers = config, workers or os.cpu_count() or 1
        self._memory_limit = memory_limit
        self._waiting.extendleft(reversed(self._running.values()))
        self._running.clear()
        self._executor.shutdown(wait=True, cancel_futures=True)
        forget_features(self._directory)
        self._executor = self._start()

    def poll(self, timeout: float) -> list[RelativeTransform]:
        """Answers that came within `timeout` seconds; one for every submitted pair in the end."""
        self._fill()
        if not self._running:
            time.sleep(timeout)
            return []
        done, _ = wait(self._running, timeout, FIRST_COMPLETED)
        results = []
        # Those that end together come in the order in which they were begun, not in that of a set.
        for future in [each for each in self._running if each in done]:
            task = self._running.pop(future)
            try:
                result = future.result()
            except BrokenProcessPool:
                self._running[future] = task
                results.extend(self._recover())
                break
            if isinstance(result, Preparation):
                self._prepared.append(result)
            else:
                results.append(result)
        self._fill()
        return results

    def take_prepared(self) -> list[Preparation]:
        """The fragments that were prepared since this was last called."""
        prepared, self._prepared = self._prepared, []
        return prepared

    def close(self) -> None:
        """End the workers and remove the folder."""
        stop_now(self._executor)
        shutil.rmtree(self._directory, ignore_errors=True)

    def _start(self) -> ProcessPoolExecutor:
        return worker_pool(
            self._workers, _start_worker, self._config, self._directory, self._memory_limit
        )

    def _fill(self) -> None:
        """Keep every worker busy, with one task more in reach; suspects run alone."""
        while self._waiting and len(self._running) <= self._workers:
            number = self._next()
            task = self._waiting[number]
            suspect = task.attempts > 0 or any(t.attempts for t in self._running.values())
            if suspect and self._running:
                return
            del self._waiting[number]
            if task.pair is not None:
                self._last_source = task.pair.source
            try:
                future = self._executor.submit(_run, task.fragment, task.pair)
            except BrokenProcessPool:
                self._waiting.appendleft(task)
                self._executor = self._start()
                continue
            self._running[future] = task

    def _next(self) -> int:
        """The first task, but a pair whose source is that of the last one goes first.

        Methods keep what they made of it.
        """
        if self._waiting[0].attempts:
            return 0
        return next(
            (
                number
                for number, task in enumerate(self._waiting)
                if task.pair is not None and task.pair.source == self._last_source
            ),
            0,
        )

    def _recover(self) -> list[RelativeTransform]:
        """After a worker died: run what was running once more, one by one, then give up on it."""
        tasks = list(self._running.values())
        self._running.clear()
        self._executor.shutdown(wait=True, cancel_futures=True)
        self._executor = self._start()
        answers = []
        for task in reversed(tasks):
            task.attempts += 1
            if task.attempts < _MOST_ATTEMPTS or len(tasks) > 1:
                self._waiting.appendleft(task)
            elif task.pair is not None:
                answers.append(worker_died(task.pair, self._config.method))
        return answers


_config: RegistrationConfig
_store: FeatureStore


def _start_worker(config: RegistrationConfig, directory: Path, memory_limit: int) -> None:
    global _config, _store  # noqa: PLW0603 - a pool's workers have no other place for their state
    _config = config
    _store = FeatureStore(
        load_method(config), directory, directory, memory_limit << 20, config.find_standpoints
    )


def _run(fragment: FragmentId, pair: FragmentPair | None) -> RelativeTransform | Preparation:
    if pair is not None:
        return _store.register(pair, _config)
    return _store.prepare(fragment)


def _sweep() -> None:
    """Remove the folders of processes that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        owner = folder.name.removeprefix(_PREFIX).split("_")[0]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(folder, ignore_errors=True)
