"""Throughput of the recorder against copying the same bytes to a file.

    ./nss python benchmarks/recorder.py

Real fragments of the bundled bag are published as fast as the recorder takes them; the clock
stops when the recorder has written the last one. The copy writes the same bytes with write().
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import rclpy
from rclpy.duration import Duration
from rich.console import Console
from rich.table import Table

from nss_msgs.msg import Fragment as FragmentMessage
from nss_ros import topics
from nss_ros.bag_reader import BagReader
from nss_ros.nodes.qos import publisher_qos

BAG = Path(__file__).parents[1] / "bags" / "three_stages"
ROUNDS = 20
DEPTH = 24


def main() -> None:
    """Measure and print a table."""
    os.environ.setdefault("ROS_DOMAIN_ID", "97")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    messages = [bytes(m.data) for m in BagReader(BAG).messages({topics.FRAGMENTS.type})] * ROUNDS
    size = sum(map(len, messages)) / 1e6
    with tempfile.TemporaryDirectory() as folder:
        copied = _copy(messages, Path(folder) / "copy")
        recorded = _record(messages, Path(folder) / "log")
    table = Table(title=f"Recording {len(messages)} fragments, {size:.0f} MB")
    for column in ("", "seconds", "MB/s", "ratio"):
        table.add_column(column, justify="right")
    table.add_row("raw bytes to a file", f"{copied:.2f}", f"{size / copied:.0f}", "1.0")
    ratio = f"{recorded / copied:.1f}"
    table.add_row("recorder, over DDS", f"{recorded:.2f}", f"{size / recorded:.0f}", ratio)
    console = Console()
    console.print(table)
    console.print("./nss python " + " ".join(sys.argv))


def _copy(messages: list[bytes], path: Path) -> float:
    begin = time.perf_counter()
    with path.open("wb") as file:
        for message in messages:
            file.write(message)
        os.fsync(file.fileno())
    return time.perf_counter() - begin


def _record(messages: list[bytes], output: Path) -> float:
    command = [sys.executable, "-m", "nss_ros.nodes.recorder", "--ros-args"]
    recorder = subprocess.Popen([*command, "-p", f"output:={output}"])
    rclpy.init()
    node = rclpy.create_node("benchmark_publisher")
    publisher = node.create_publisher(
        FragmentMessage, topics.FRAGMENTS.name, publisher_qos(topics.FRAGMENTS, DEPTH)
    )
    while publisher.get_subscription_count() == 0:
        time.sleep(0.05)
    begin = time.perf_counter()
    for start in range(0, len(messages), DEPTH):
        for message in messages[start : start + DEPTH]:
            publisher.publish(message)
        while not publisher.wait_for_all_acked(Duration(seconds=1.0)):
            pass
    recorder.terminate()
    recorder.wait()
    seconds = time.perf_counter() - begin
    node.destroy_node()
    rclpy.shutdown()
    count = sum(1 for _ in BagReader(output).messages({topics.FRAGMENTS.type}))
    if count != len(messages):
        raise RuntimeError(f"the recorder wrote {count} of {len(messages)} fragments")
    return seconds


if __name__ == "__main__":
    main()
