"""Ctrl-C at awkward moments: no failure, no traceback."""

import signal
import subprocess
import sys

import pytest
import rclpy
from std_msgs.msg import Empty

from nss_ros.nodes.spin import Background

_INTERRUPT_WHILE_IMPORTING = """
import os, signal, sys
from nss_ros.nodes import start

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "scipy":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
start.{node}()
"""


@pytest.mark.parametrize("node", ["fragment_player", "registration", "pose_graph"])
def test_an_interrupt_while_a_node_is_imported_ends_it_quietly(node: str):
    command = [sys.executable, "-c", _INTERRUPT_WHILE_IMPORTING.format(node=node)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (process.returncode, process.stderr) == (0, "")


@pytest.fixture
def node():
    rclpy.init()
    node = rclpy.create_node("publisher")
    yield node
    rclpy.try_shutdown()
    node.destroy_node()


def test_publishing_when_the_context_ends_is_no_failure(node):
    publisher = node.create_publisher(Empty, "topic", 1)

    def publish() -> None:
        while True:
            publisher.publish(Empty())

    background = Background("publish", publish)
    background.start()
    rclpy.shutdown()
    background.stop()
    assert background.error is None


@pytest.mark.usefixtures("node")
def test_another_error_after_the_end_of_the_context_is_a_failure():
    def fail() -> None:
        background.stopping.wait()
        raise OSError("the disk is full")

    background = Background("write", fail)
    background.start()
    rclpy.shutdown()
    background.stop()
    assert isinstance(background.error, OSError)


def test_impatient_interrupts_still_end_a_node_cleanly(graph, tmp_path):
    process = graph.start("recorder", output=str(tmp_path / "log"))
    graph.wait((tmp_path / "log").exists)
    graph.wait(lambda: graph.node.count_subscribers("/fragments") == 1)
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
    assert process.returncode == 0
    assert (tmp_path / "log/metadata.yaml").exists()
