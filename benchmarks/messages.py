"""Round trip of a fragment message, publish to decoded array, against a raw copy of its bytes.

    ./nss python benchmarks/messages.py

Publisher and subscriber are two processes, as in a real graph; each fragment is published when
the one before has arrived, so the figure is latency without queueing.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import time
from multiprocessing.connection import Connection

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rich.console import Console
from rich.table import Table

from nss_msgs.msg import Fragment as FragmentMessage
from nss_ros import topics
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.messages import fragment_from, fragment_message, rosidl_family
from nss_ros.nodes.qos import publisher_qos, subscription_qos

SIZES = (10_000, 30_000, 100_000, 500_000)
REPEATS = 20


def main() -> None:
    """Measure and print a table."""
    os.environ.setdefault("ROS_DOMAIN_ID", "98")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    table = Table(title="Fragment message round trip (median)")
    for column in ("points", "MB", "round trip ms", "raw copy ms", "ratio"):
        table.add_column(column, justify="right")
    for size in SIZES:
        points = np.random.default_rng(0).normal(size=(size, 3)).astype(np.float32)
        trip, copy = _round_trip(points), _raw_copy(points)
        table.add_row(
            f"{size:,}",
            f"{points.nbytes / 1e6:.2f}",
            f"{1e3 * trip:.2f}",
            f"{1e3 * copy:.3f}",
            f"{trip / copy:.0f}",
        )
    console = Console()
    console.print(table)
    console.print("./nss python " + " ".join(sys.argv))


def _raw_copy(points: np.ndarray) -> float:
    data = points.tobytes()
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        bytearray(data)
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def _round_trip(points: np.ndarray) -> float:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    subscriber = context.Process(target=_subscribe, args=(theirs,), daemon=True)
    subscriber.start()
    rclpy.init()
    node = rclpy.create_node("benchmark_publisher")
    publisher = node.create_publisher(
        FragmentMessage, topics.FRAGMENTS.name, publisher_qos(topics.FRAGMENTS, 1)
    )
    while publisher.get_subscription_count() == 0:
        time.sleep(0.05)
    fragment = Fragment(FragmentId("1", 1, 1), points)
    seconds = []
    for _ in range(REPEATS + 3):
        begin = time.perf_counter()
        publisher.publish(fragment_message(fragment, 1, rosidl_family()))
        seconds.append(ours.recv() - begin)
    node.destroy_node()
    rclpy.shutdown()
    subscriber.terminate()
    subscriber.join()
    return float(np.median(seconds[3:]))


def _subscribe(connection: Connection) -> None:
    rclpy.init()
    node = rclpy.create_node("benchmark_subscriber")

    def receive(message: FragmentMessage) -> None:
        fragment_from(message)
        # perf_counter is the system's monotonic clock: comparable between processes.
        connection.send(time.perf_counter())

    node.create_subscription(
        FragmentMessage, topics.FRAGMENTS.name, receive, subscription_qos(topics.FRAGMENTS)
    )
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
