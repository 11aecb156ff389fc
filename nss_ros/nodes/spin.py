"""The main function of every node: start, spin, stop cleanly, report errors in one sentence."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from nss_ros.errors import NssError

# Process id of the launcher, set by it.
LAUNCHER_VARIABLE = "NSS_LAUNCHER"
_WATCH_PERIOD = 0.5


class Background:
    """A node's worker thread, whose failure ends the node.

    Callbacks of a node only enqueue; this thread computes. That keeps a single-threaded
    executor responsive (ROS_ENVIRONMENT: it beats a multi-threaded one).

    Args:
        name: thread name.
        work: runs until `stopping` is set.
    """

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self.stopping = threading.Event()
        self.error: BaseException | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, timeout: float = 30.0) -> None:
        """Ask the thread to end, and wait for it."""
        self.stopping.set()
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            # Ctrl-C ends the context under a thread that is just publishing: no failure.
            if rclpy.ok() or not isinstance(error, RCLError):
                self.error = error
            rclpy.try_shutdown()


def run_node(make: Callable[[], Any], args: list[str] | None = None) -> int:
    """Run a node until it is told to stop; the exit status of the process.

    Args:
        make: creates the node. It must have `close()`, which ends its threads and processes, and
            `background`, its worker thread.
        args: command-line arguments, default those of the process.
    """
    node: Any = None
    status = 0
    # rclpy's own handler ends the context, and spinning with it. Python's would also raise
    # KeyboardInterrupt, wherever that may be: in the middle of closing a log, for example.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    try:
        rclpy.init(args=args)
        _follow_launcher()
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except ExternalShutdownException:
        pass
    except NssError as error:
        status = _report(error)
    except Exception:
        if rclpy.ok():  # else the node was told to stop while it was starting
            raise
    finally:
        # Ignored from here on: a handler of ours would not outlive the interpreter's own end.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            status = _close(node) or status
        rclpy.try_shutdown()
    return status


def _follow_launcher() -> None:
    """Stop, cleanly, when the process that launched this node is gone: it cannot stop us then."""
    launcher = os.environ.get(LAUNCHER_VARIABLE)
    if launcher is None:
        return

    def watch() -> None:
        while os.getppid() == int(launcher):
            time.sleep(_WATCH_PERIOD)
        rclpy.try_shutdown()

    threading.Thread(target=watch, name="launcher", daemon=True).start()


def _close(node: Any) -> int:
    try:
        node.close()
    except NssError as error:
        return _report(error)
    failure: BaseException | None = node.background.error
    if failure is None:
        return 0
    if isinstance(failure, NssError):
        return _report(failure)
    raise failure


def _report(error: BaseException) -> int:
    print(f"error: {error}", file=sys.stderr, flush=True)
    return 1
