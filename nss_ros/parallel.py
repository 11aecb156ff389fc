"""Independent calls on all cores of one machine (joblib), or of a Ray cluster.

`run` gives results in the order of the items, so whatever runs where, the outcome is the same;
`stream` gives each as soon as it is there.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from enum import StrEnum
from functools import cache, lru_cache, partial
from typing import Any, TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

from nss_ros.errors import InputError, WorkerDiedError
from nss_ros.listening import knock
from nss_ros.worker_process import WORKER_ENVIRONMENT, end_with, stop_now, worker_pool

Item = TypeVar("Item")
Result = TypeVar("Result")

# Calls that are handed out at a time for each worker: one runs, one is in reach. With more than
# fit joblib's queue, its thread stumbles over the rest when the caller is interrupted.
_IN_REACH = 2


class Engine(StrEnum):
    """Where calls run."""

    LOCAL = "local"
    RAY = "ray"


def run(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int = 0,
    engine: Engine = Engine.LOCAL,
) -> Iterator[Result]:
    """Results of a function for all items, in their order, as they come.

    Each call has one thread of the linear algebra libraries, in this process too, so that the
    results are the same bytes for any number of workers. Items are taken as they are needed.

    Args:
        function: importable by name, with arguments and results that can be pickled.
        items: one call each.
        workers: processes; 0: one per core of the machine, or all that the Ray cluster has.
            1 without Ray: this process.
        engine: local processes, or the Ray cluster that RAY_ADDRESS names (one on this machine
            is started if it names none).

    Raises:
        InputError: Ray was asked for and is not installed, or its cluster does not answer.
        WorkerDiedError: a process was killed or crashed.
    """
    call = partial(_call, function)
    if engine is Engine.RAY:
        yield from _on_ray(call, items, workers, in_order=True)
    elif workers == 1:
        yield from map(call, items)
    else:
        yield from _on_joblib(call, items, workers, in_order=True)


def stream(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int = 0,
    engine: Engine = Engine.LOCAL,
) -> Iterator[Result]:
    """As `run`, each result as soon as it is there, in any order; never in this process.

    After a WorkerDiedError the results of some of the items that were taken are missing.
    """
    call = partial(_call, function)
    if engine is Engine.RAY:
        yield from _on_ray(call, items, workers, in_order=False)
    elif workers == 1:
        yield from _in_one_process(call, items)
    else:
        yield from _on_joblib(call, items, workers, in_order=False)


def end_workers() -> None:
    """End the processes of joblib, which else wait for further calls for minutes."""
    get_reusable_executor().shutdown(wait=True)


def _call(function: Callable[[Item], Result], item: Item) -> Result:
    with _libraries(len(sys.modules)).limit(limits=1):
        return function(item)


@lru_cache(maxsize=1)
def _libraries(_: int) -> ThreadpoolController:
    """The libraries that are loaded; looked up again when modules were imported since."""
    return ThreadpoolController()


def _on_joblib(
    call: Callable[[Item], Result], items: Iterable[Item], workers: int, in_order: bool
) -> Iterator[Result]:
    how = "generator" if in_order else "generator_unordered"
    bound = partial(_bound_call, os.getpid(), call)
    # Loky replaces a process whose memory grew, between two calls; nothing is lost.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    with _worker_environment(), parallel_config("loky"):
        calls = Parallel(
            n_jobs=workers or os.cpu_count() or 1,
            return_as=how,
            pre_dispatch=f"{_IN_REACH}*n_jobs",
        )
        try:
            yield from calls(delayed(bound)(item) for item in items)
        except TerminatedWorkerError as error:
            raise _death() from error


def _bound_call(parent: int, call: Callable[[Item], Result], item: Item) -> Result:
    if os.getppid() == parent:  # joblib without processes has none
        _end_with(parent)
    return call(item)


@cache
def _end_with(parent: int) -> None:
    end_with(parent)  # joblib's processes would wait for minutes


def _in_one_process(call: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    waiting: set[Future[Result]] = set()
    pool = worker_pool(1)
    try:
        for item in items:
            waiting.add(pool.submit(call, item))
            if len(waiting) > 1:  # one that runs, one in reach
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        yield from (future.result() for future in waiting)
    except BrokenProcessPool as error:
        raise _death() from error
    finally:
        stop_now(pool)


def _on_ray(
    call: Callable[[Item], Result], items: Iterable[Item], workers: int, in_order: bool
) -> Iterator[Result]:
    ray = _connected_ray()
    remote = ray.remote(max_retries=1)(_called)
    # All workers are busy if there are as many calls as workers; in order, some wait for others.
    most = workers or _IN_REACH * max(1, int(ray.cluster_resources().get("CPU", 1)))
    waiting: list[Any] = []

    def next_result() -> Any:
        ready = waiting[0] if in_order else ray.wait(waiting, num_returns=1)[0][0]
        waiting.remove(ready)
        return ray.get(ready)

    try:
        for item in items:
            waiting.append(remote.remote(call, item))
            if len(waiting) >= most:
                yield next_result()
        while waiting:
            yield next_result()
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error  # the error of the call, as it is without Ray
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError) as error:
        raise _death() from error
    finally:
        for reference in waiting:
            ray.cancel(reference)


def _called(call: Callable[[Item], Result], item: Item) -> Result:
    return call(item)  # Ray takes functions, and no partial ones


def _connected_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise InputError(
            "The engine 'ray' needs the package ray: pip install 'ray', or use the engine 'local'."
        ) from error
    if not ray.is_initialized():
        address = os.environ.get("RAY_ADDRESS", "")
        try:
            if address:
                knock(address)
                ray.init(log_to_driver=False, logging_level=logging.ERROR)
            else:
                ray.init(
                    address="local",
                    include_dashboard=False,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                )
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(
                f"No Ray cluster answers at RAY_ADDRESS={address}: start one with 'ray start', or "
                "use the engine 'local'."
            ) from error
    return ray


def _death() -> WorkerDiedError:
    return WorkerDiedError("A worker process was killed or crashed: is there enough memory?")


@contextmanager
def _worker_environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in WORKER_ENVIRONMENT}
    os.environ |= WORKER_ENVIRONMENT  # read by the workers when they start
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
