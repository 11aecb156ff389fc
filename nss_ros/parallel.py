"""Independent calls on all cores of one machine (joblib), or of a Ray cluster.

Results come in the order of the items, so whatever runs where, the outcome is the same.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from functools import cache, partial
from typing import TypeVar

from joblib import Parallel, delayed, parallel_config
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

from nss_ros.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

# With more threads than cores numpy is slower, and its sums depend on the number of threads.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
    """Results of a function for all items, in their order, as they come (with Ray: at the end).

    Each call has one thread of the linear algebra libraries, in this process too, so that the
    results are the same bytes for any number of workers.

    Args:
        function: importable by name, with arguments and results that can be pickled.
        items: one call each.
        workers: processes; 0: one per core of the machine, or all that the Ray cluster has.
            1 without Ray: this process.
        engine: local processes, or the Ray cluster that RAY_ADDRESS names (one on this machine
            is started if it names none).

    Raises:
        InputError: Ray was asked for and is not installed.
    """
    call = partial(_call, function)
    if engine is Engine.LOCAL and workers == 1:
        yield from map(call, items)
        return
    with _backend(engine):
        count = workers or (-1 if engine is Engine.RAY else os.cpu_count() or 1)
        # joblib's Ray backend gives its results all at once, at the end.
        how = "generator" if engine is Engine.LOCAL else "list"
        calls = Parallel(n_jobs=count, return_as=how, pre_dispatch="4*n_jobs")
        yield from calls(delayed(call)(item) for item in items)


def _call(function: Callable[[Item], Result], item: Item) -> Result:
    with _libraries().limit(limits=1):
        return function(item)


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def _backend(engine: Engine) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ |= dict.fromkeys(_ONE_THREAD, "1")  # read by the workers when they start
    try:
        if engine is Engine.LOCAL:
            with parallel_config("loky"):
                yield
        else:
            _register_ray()
            with parallel_config("ray"):
                yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _register_ray() -> None:
    try:
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise InputError(
            "The engine 'ray' needs the package ray: pip install 'ray', or use the engine 'local'."
        ) from error
    register_ray()
