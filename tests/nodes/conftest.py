"""Real nodes over DDS, each test in a domain of its own."""

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("nss_msgs.msg")

import rclpy
from rclpy.executors import SingleThreadedExecutor

from nss_ros.bag import write_bag
from nss_ros.config import load_config
from nss_ros.nodes.launcher import Launcher
from nss_ros.nodes.parameters import ros_parameters

# Tests run several at a time, by workers that have 20 domains each.
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 4
_DOMAINS = itertools.count(os.getpid() % 20)


@pytest.fixture(autouse=True)
def domain(monkeypatch) -> int:
    """A ROS domain that no other test uses at the same time, on this machine only."""
    number = 10 + 20 * _WORKER + next(_DOMAINS) % 20
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return number


@pytest.fixture(scope="module")
def domain_of_module() -> Iterator[int]:
    """A ROS domain for what the tests of a module share."""
    number = 5 + _WORKER
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield number


@pytest.fixture(scope="session")
def room_bag(tmp_path_factory, room) -> Path:
    path = tmp_path_factory.mktemp("bags") / "room"
    write_bag(path, room.fragments, room.pairs, [room.ground_truth])
    return path


class Graph:
    """Nodes started by a test, and a node of the test's own to talk to them."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.launcher = Launcher("", directory)
        self.config = load_config(
            None, ["player.rate=0", "pose_graph.update_period=0.5", "registration.workers=2"]
        )
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("tester", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients: dict = {}

    def start(self, executable: str, name: str = "", **changes):
        """Start a node with the test's settings and some changed ones; the process."""
        section = "player" if executable == "fragment_player" else executable
        parameters = ros_parameters(getattr(self.config, section)) | changes
        self.launcher.start(executable, parameters, name)
        return self.launcher.nodes[-1].process

    def output(self, name: str) -> str:
        return (self.directory / f"{name}.log").read_text()

    def wait(self, condition: Callable[[], object], timeout: float = 180.0) -> None:
        assert self._comes_true(condition, timeout), self._outputs()

    def wait_until_settled(self, graphs: list, pairs: int, fragments: int) -> None:
        """Until a map has all answers and all fragments, which come in any order."""
        self.wait(
            lambda: (
                graphs
                and graphs[-1].settled
                and graphs[-1].pairs_answered >= pairs
                and len(graphs[-1].nodes) >= fragments
            )
        )

    def call(self, service_type: type, name: str, **fields):
        """The answer of a service.

        It is asked again when no answer comes: that of a node which has not found the client yet
        is lost, and on a busy machine finding takes longer than DDS waits.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(service_type, name)
        client = self._clients[name]
        self.wait(client.service_is_ready)
        for _ in range(4):
            future = client.call_async(service_type.Request(**fields))
            if self._comes_true(future.done, 45.0):
                return future.result()
        raise AssertionError(f"{name} does not answer: {self._outputs()}")

    def publishers(self, types: dict) -> dict:
        """A publisher of the test for each topic, of the type that is given for it."""
        from nss_ros.nodes.qos import publisher_qos

        return {
            topic: self.node.create_publisher(message_type, topic.name, publisher_qos(topic))
            for topic, message_type in types.items()
        }

    def listen(self, topic, message_type: type) -> list:
        """The messages of a topic, appended as they come."""
        from nss_ros.nodes.qos import subscription_qos

        messages: list = []
        self.node.create_subscription(
            message_type, topic.name, messages.append, subscription_qos(topic)
        )
        return messages

    def close(self) -> None:
        self.launcher.stop()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def _comes_true(self, condition: Callable[[], object], timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _outputs(self) -> str:
        return "\n".join(
            f"{file.name}: {file.read_text()}" for file in self.directory.glob("*.log")
        )


@pytest.fixture
def graph(tmp_path) -> Iterator[Graph]:
    directory = tmp_path / "nodes"
    directory.mkdir()
    graph = Graph(directory)
    yield graph
    graph.close()
