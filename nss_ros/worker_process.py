"""Pools of worker processes that compute with one thread and never outlive their parent."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

_WATCH_PERIOD = 0.5
# For the thread of a pool whose processes were killed, seconds.
_PATIENCE = 0.5
# With more threads than cores numpy is slower, and its sums depend on the number of threads.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# glibc gives freed arrays back to the system, which clears them again for the next ones: with its
# defaults a tenth of the time of a simulated scan. Where a process has freed a large array, glibc
# sets the limits to these by itself.
_KEEP_MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(2**25), "MALLOC_TRIM_THRESHOLD_": str(2**26)}
WORKER_ENVIRONMENT = dict.fromkeys(_ONE_THREAD, "1") | _KEEP_MEMORY
"""Environment variables of worker processes; libraries read them when they are loaded."""


class _Process(SpawnProcess):
    """Never sees Ctrl-C, which a terminal sends to all processes: the parent ends this one."""

    def start(self) -> None:
        # Inherited, so that it holds from the first instruction of the child on.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class _Context(SpawnContext):
    Process = _Process


def worker_pool(
    workers: int, initializer: Callable[..., None] | None = None, *arguments: Any
) -> ProcessPoolExecutor:
    """A pool of fresh processes.

    One thread each: the workers are the parallelism, and sums in one order make results
    reproducible to the bit. The environment is set here, because the libraries read it when they
    are loaded, which in a fresh process is before any initializer runs.

    Args:
        workers: number of processes.
        initializer: called in each process with the arguments.
        arguments: picklable.
    """
    os.environ.update(WORKER_ENVIRONMENT)
    return ProcessPoolExecutor(
        workers,
        mp_context=_Context(),
        initializer=_start,
        initargs=(os.getpid(), initializer, arguments),
    )


def stop_now(pool: ProcessPoolExecutor) -> None:
    """End a pool without waiting for what it computes."""
    manager, calls = (vars(pool)[name] for name in ("_executor_manager_thread", "_call_queue"))
    for process in list((pool._processes or {}).values()):
        process.kill()
    pool.shutdown(wait=False, cancel_futures=True)
    if manager is None:
        return
    manager.join(_PATIENCE)
    if manager.is_alive():
        # It waits until a call is written into a pipe that only this process could still read
        # (CPython gh-94777; Python 3.11.2 of Debian 12 has it).
        with suppress(OSError):
            calls._reader.close()
        manager.join()


def end_with(parent: int) -> None:
    """Have this process end with its parent, even when that was killed and could not say so."""
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _start(
    parent: int, initializer: Callable[..., None] | None, arguments: tuple[Any, ...]
) -> None:
    end_with(parent)
    if initializer is not None:
        initializer(*arguments)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_WATCH_PERIOD)
    os._exit(1)
