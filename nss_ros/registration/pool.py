"""Registration of many pairs by worker processes that share features through a folder.

Each worker keeps what it used last in memory, up to a limit; everything else waits on disk.
A worker that dies takes one pair with it, not the run.
"""

from __future__ import annotations

import os
import pickle
import shutil
import tempfile
import time
from collections import OrderedDict, deque
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, voxelize
from nss_ros.registration.method import Method, load_method
from nss_ros.registration.pair import register_pair
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed
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
        self._running: dict[Future[RelativeTransform | None], _Task] = {}

    def add_fragment(self, fragment: Fragment) -> None:
        """Take a fragment in, voxelised, and have its features computed."""
        points = voxelize(fragment.points, self._config.voxel_size)
        _save(
            self._directory / f"{fragment.id}.fragment",
            Fragment(fragment.id, points, fragment.gravity_aligned),
        )
        self._waiting.append(_Task(fragment.id))

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
        for path in self._directory.glob("*.features"):
            path.unlink()
        self._executor = self._start()

    def poll(self, timeout: float) -> list[RelativeTransform]:
        """Answers that came within `timeout` seconds; one for every submitted pair in the end."""
        self._fill()
        if not self._running:
            time.sleep(timeout)
            return []
        done, _ = wait(self._running, timeout, FIRST_COMPLETED)
        results = []
        for future in done:
            task = self._running.pop(future, None)
            if task is None:
                continue
            try:
                result = future.result()
            except BrokenProcessPool:
                self._running[future] = task
                results.extend(self._recover())
                break
            if result is not None:
                results.append(result)
        self._fill()
        return results

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
            task = self._waiting[0]
            suspect = task.attempts > 0 or any(t.attempts for t in self._running.values())
            if suspect and self._running:
                return
            self._waiting.popleft()
            try:
                future = self._executor.submit(_run, task.fragment, task.pair)
            except BrokenProcessPool:
                self._waiting.appendleft(task)
                self._executor = self._start()
                continue
            self._running[future] = task

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
                message = "The worker process that registered this pair died twice."
                answers.append(failed(task.pair, self._config.method, Reason.WORKER_DIED, message))
        return answers


class _FeatureCache:
    """Features by fragment: in memory up to a limit, else on disk, else computed."""

    def __init__(self, method: Method, directory: Path, limit: int) -> None:
        self._method = method
        self._directory = directory
        self._limit = limit
        self._size = 0
        self._entries: OrderedDict[FragmentId, tuple[Any, int]] = OrderedDict()

    def get(self, id_: FragmentId) -> Any:
        if id_ in self._entries:
            self._entries.move_to_end(id_)
            return self._entries[id_][0]
        path = self._directory / f"{id_}.features"
        if path.exists():
            data = path.read_bytes()
            features = pickle.loads(data)
            size = len(data)
        else:
            fragment = pickle.loads((self._directory / f"{id_}.fragment").read_bytes())
            features = self._method.prepare(fragment)
            size = _save(path, features)
        self._entries[id_] = (features, size)
        self._size += size
        while self._size > self._limit and len(self._entries) > 2:
            self._size -= self._entries.popitem(last=False)[1][1]
        return features


@dataclass(slots=True)
class _Worker:
    config: RegistrationConfig
    method: Method
    cache: _FeatureCache


_worker: _Worker


def _start_worker(config: RegistrationConfig, directory: Path, memory_limit: int) -> None:
    global _worker  # noqa: PLW0603 - a pool's workers have no other place for their state
    method = load_method(config)
    _worker = _Worker(config, method, _FeatureCache(method, directory, memory_limit << 20))


def _run(fragment: FragmentId, pair: FragmentPair | None) -> RelativeTransform | None:
    if pair is not None:
        return _register(pair)
    _prepare(fragment)
    return None


def _prepare(id_: FragmentId) -> None:
    try:
        _worker.cache.get(id_)
    except Exception:
        return  # the pair that needs it reports the error


def _register(pair: FragmentPair) -> RelativeTransform:
    try:
        source, target = _worker.cache.get(pair.source), _worker.cache.get(pair.target)
    except Exception as error:
        message = f"Features could not be computed: {error}"
        return failed(pair, _worker.config.method, Reason.METHOD_ERROR, message)
    return register_pair(_worker.method, source, target, pair, _worker.config)


def _save(path: Path, value: Any) -> int:
    """Pickle to a file that appears whole, so that workers may race; the size in bytes."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    temporary = path.with_suffix(f".{os.getpid()}")
    temporary.write_bytes(data)
    temporary.replace(path)
    return len(data)


def _sweep() -> None:
    """Remove the folders of processes that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        owner = folder.name.removeprefix(_PREFIX).split("_")[0]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(folder, ignore_errors=True)
