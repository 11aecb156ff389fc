"""One mapping run: the whole graph as processes, from bags to a log."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

from nss_ros.bag_reader import bag_files
from nss_ros.config import NssConfig
from nss_ros.errors import InputError, NodeError, RunError
from nss_ros.multiway.synchronizer import find_synchronizer
from nss_ros.nodes.launcher import Launcher
from nss_ros.nodes.monitor import Monitor, Progress
from nss_ros.nodes.parameters import ros_parameters
from nss_ros.registration.method import find_method

_SPIN = 0.2
_DISCOVERY = 1.0


def run_mapping(
    bags: Sequence[Path],
    output: Path,
    config: NssConfig,
    *,
    namespace: str = "",
    registration_nodes: int = 1,
    timeout: float = 0.0,
    report: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Play bags through the real graph until every pair is answered and the map is settled.

    Args:
        bags: played one after the other.
        output: folder of the log to write.
        config: of all nodes.
        namespace: of all nodes and topics.
        registration_nodes: nodes that share the pairs.
        timeout: seconds after which the run is given up; 0: never.
        report: called several times a second.

    Returns:
        The final state.

    Raises:
        InputError: the namespace is not one.
        MethodError: a method is not installed.
        BagError: a bag cannot be read.
        RunError: a node died, another graph is in the way, or time ran out. What was recorded
            until then is kept.
    """
    _check_namespace(namespace)
    find_method(config.registration.method)
    find_synchronizer(config.pose_graph.synchronizer)
    for bag in bags:
        bag_files(bag)
    if output.exists():
        raise RunError(f"{output} exists already: choose another name or remove it.")
    directory = Path(tempfile.mkdtemp(prefix="nss_map_"))
    try:
        progress = _run(
            directory, bags, output, config, namespace, registration_nodes, timeout, report
        )
    except NodeError:
        raise  # its message points to the output of a node
    except BaseException:
        shutil.rmtree(directory)
        raise
    shutil.rmtree(directory)
    return progress


def _run(
    directory: Path,
    bags: Sequence[Path],
    output: Path,
    config: NssConfig,
    namespace: str,
    registration_nodes: int,
    timeout: float,
    report: Callable[[Progress], None],
) -> Progress:
    lock = _only_run(namespace)
    monitor = Monitor(namespace, registration_nodes)
    launcher = Launcher(namespace, directory)
    try:
        monitor.spin(_DISCOVERY)
        _refuse_company(monitor)
        _start(launcher, directory, bags, output, config, registration_nodes)
        progress = _watch(launcher, monitor, timeout, report)
        monitor.spin(2 * config.recorder.flush_period)
    finally:
        unclean = launcher.stop()
        monitor.close()
        lock.close()
    if unclean:
        raise NodeError(
            f"Node {unclean[0]} did not stop cleanly: see {directory / unclean[0]}.log."
        )
    progress.warnings = launcher.warnings()
    return progress


def _only_run(namespace: str) -> IO[str]:
    """A lock against runs that start at the same moment and cannot see each other's nodes yet.

    Raises:
        RunError: another run holds it.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    name = f"nss_map_{os.getuid()}_{domain}_{namespace.strip('/').replace('/', '-')}.lock"
    lock = (Path(tempfile.gettempdir()) / name).open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        raise _company("another 'nss map'") from error
    return lock


def _check_namespace(namespace: str) -> None:
    try:
        validate_namespace(f"/{namespace.strip('/')}")
    except InvalidNamespaceException as error:
        raise InputError(
            f"'{namespace}' cannot be a namespace: use letters, digits and '_', with single '/' "
            "between parts that do not start with a digit."
        ) from error


def _start(
    launcher: Launcher,
    directory: Path,
    bags: Sequence[Path],
    output: Path,
    config: NssConfig,
    registration_nodes: int,
) -> None:
    metadata = directory / "metadata.json"
    metadata.write_text(json.dumps({"config": config.model_dump_json()}))
    recorder = config.recorder.model_copy(
        update={"output": str(output.absolute()), "metadata_file": str(metadata)}
    )
    # A run ends by itself, so its player neither waits for a person nor starts again.
    player = config.player.model_copy(
        update={
            "bags": [str(bag.absolute()) for bag in bags],
            "start_paused": False,
            "loop": False,
        }
    )
    launcher.start("recorder", ros_parameters(recorder))
    launcher.start("pose_graph", ros_parameters(config.pose_graph))
    workers = config.registration.workers or max(1, (os.cpu_count() or 1) // registration_nodes)
    for index in range(registration_nodes):
        share = config.registration.model_copy(
            update={
                "shard_index": index,
                "shard_count": registration_nodes,
                "workers": workers,
            }
        )
        name = "registration" if registration_nodes == 1 else f"registration_{index}"
        launcher.start("registration", ros_parameters(share), name)
    launcher.start("fragment_player", ros_parameters(player))


def _watch(
    launcher: Launcher, monitor: Monitor, timeout: float, report: Callable[[Progress], None]
) -> Progress:
    begin = time.monotonic()
    while True:
        progress = monitor.spin(_SPIN)
        report(progress)
        if progress.complete:
            return progress
        launcher.check()
        if 0 < timeout < time.monotonic() - begin:
            raise RunError(
                f"The run was not complete after {timeout:.0f} s: "
                f"{progress.pairs_answered} of {progress.pairs_total} pairs were answered."
            )


def _refuse_company(monitor: Monitor) -> None:
    others = monitor.foreign_publishers()
    if others:
        raise _company(", ".join(others))


def _company(others: str) -> RunError:
    return RunError(
        f"Another graph is running here ({others}): stop it, or give this run its own "
        "--namespace or ROS_DOMAIN_ID."
    )
