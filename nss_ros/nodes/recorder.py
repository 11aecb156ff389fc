"""Node `recorder`: logs the run to MCAP, byte for byte.

Messages go from DDS to the file as CDR, undecoded; only playback status is looked at, to note
which bags were played. Everything that was flushed survives a kill -9.
"""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from rclpy.node import Node
from rclpy.serialization import deserialize_message

from nss_msgs.msg import PlaybackStatus
from nss_ros import topics
from nss_ros.bag_reader import BagReader, bag_digest
from nss_ros.bag_writer import BagWriter
from nss_ros.config import RecorderConfig
from nss_ros.errors import BagError, ConfigError
from nss_ros.nodes.diagnostics import Health, publish_diagnostics
from nss_ros.nodes.parameters import declare_parameters
from nss_ros.nodes.qos import subscription_qos
from nss_ros.nodes.spin import Background, run_node
from nss_ros.topics import Topic
from nss_ros.versions import run_versions

_ALWAYS = (
    topics.GROUND_TRUTH,
    topics.FRAGMENT_PAIRS,
    topics.PLAYBACK_STATUS,
    topics.RELATIVE_TRANSFORMS,
    topics.POSE_GRAPH,
    topics.FRAGMENT_POSES,
    topics.TF,
    topics.CLOCK,
    topics.DIAGNOSTICS,
)
_MAPS = (topics.MAP, topics.MARKERS)
_PARTS_PERIOD = 0.5


class Recorder(Node):
    """Writes every topic of the interface to a rosbag2 MCAP log.

    Raises:
        ConfigError: there is no output, or the metadata file is not valid.
        BagError: the output exists or cannot be created.
    """

    def __init__(self) -> None:
        super().__init__("recorder")
        self._config = declare_parameters(self, RecorderConfig)
        if not self._config.output:
            raise ConfigError("The recorder has no output: set its parameter 'output' to a folder.")
        metadata = _read_metadata(self._config.metadata_file)
        self._writer = BagWriter(Path(self._config.output))
        self._writer.add_metadata(run_versions() | metadata)
        self._messages: SimpleQueue[tuple[str, int, bytes]] = SimpleQueue()
        self._bags: set[str] = set()
        self._count = self._bytes = 0
        self._topics: dict[str, Topic] = {}
        wanted = [*_ALWAYS, *(_MAPS if self._config.record_maps else ())]
        if self._config.record_fragments:
            wanted.append(topics.FRAGMENTS)
        for topic in wanted:
            self._writer.add_topic(self.resolve_topic_name(topic.name), topic)
            self._subscribe(topic)
        if self._config.record_maps:
            self.create_timer(_PARTS_PERIOD, self._find_parts_of_map)
        publish_diagnostics(self, self._health)
        self.background = Background("write", self._work)
        self.background.start()

    def close(self) -> None:
        """Write what is left, the index and `metadata.yaml`."""
        self.background.stop()
        if self.background.error is not None:
            self._writer.abort()
            return
        try:
            self._drain()
            self._writer.close()
        except OSError as error:
            raise self._write_error(error) from error

    def _subscribe(self, topic: Topic) -> None:
        package, _, name = topic.type.split("/")
        message_type = getattr(import_module(f"{package}.msg"), name)
        resolved = self.resolve_topic_name(topic.name)
        self._topics[resolved] = topic

        def record(data: bytes) -> None:
            self._messages.put((resolved, time.time_ns(), data))
            if topic == topics.PLAYBACK_STATUS:
                self._note_bags(data)

        self.create_subscription(
            message_type, topic.name, record, subscription_qos(topic), raw=True
        )

    def _find_parts_of_map(self) -> None:
        prefix = self.resolve_topic_name(topics.MAP.name).removesuffix(topics.MAP.name)
        for name, _ in self.get_topic_names_and_types():
            topic = topics.part_of_map(name.removeprefix(prefix))
            if topic is not None and name.startswith(prefix) and name not in self._topics:
                self._subscribe(topic)

    def _note_bags(self, data: bytes) -> None:
        status = deserialize_message(data, PlaybackStatus)
        for bag in status.bags:
            if bag not in self._bags:
                self._bags.add(bag)
                self._messages.put(("", len(self._bags) - 1, bag.encode()))

    def _health(self) -> Health:
        values = {"messages": self._count, "bytes": self._bytes, "waiting": self._messages.qsize()}
        return True, f"recording to {self._config.output}", values

    def _work(self) -> None:
        try:
            while not self.background.stopping.wait(self._config.flush_period):
                self._drain()
                self._writer.flush()
        except OSError as error:
            raise self._write_error(error) from error

    def _drain(self) -> None:
        while True:
            try:
                name, stamp, data = self._messages.get_nowait()
            except Empty:
                return
            if not name:
                self._writer.add_metadata(_bag_metadata(data.decode(), stamp))
                continue
            # Announced here, for those found on the way: two threads at the writer lose records.
            self._writer.add_topic(name, self._topics[name])
            self._writer.write(name, stamp, data)
            self._count += 1
            self._bytes += len(data)

    def _write_error(self, error: OSError) -> BagError:
        return BagError(
            f"Cannot write the log {self._config.output}: {error.strerror}. "
            "What was written before is readable."
        )


def _bag_metadata(bag: str, index: int) -> dict[str, str]:
    """Path, hash and own metadata of a bag that is played; only the path if it is not here."""
    values = {f"bag_{index}": bag}
    try:
        digest = bag_digest(Path(bag))
        reader = BagReader(Path(bag))
        for _ in reader.messages(()):
            pass
    except (BagError, OSError):
        return values
    return reader.metadata | values | {f"bag_{index}_sha256": digest}


def _read_metadata(name: str) -> dict[str, str]:
    if not name:
        return {}
    try:
        values: Any = json.loads(Path(name).read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"Cannot read the metadata file {name}: {error}.") from error
    if not isinstance(values, dict) or not all(isinstance(v, str) for v in values.values()):
        raise ConfigError(f"The metadata file {name} must be a JSON object of strings.")
    return values


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    sys.exit(run_node(Recorder, args))


if __name__ == "__main__":
    main()
