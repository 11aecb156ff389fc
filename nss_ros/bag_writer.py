"""Writing rosbag2 MCAP bags: a folder with `metadata.yaml` and one `.mcap` file.

Written through the `mcap` library, because its writer can be flushed: everything up to the
last flush is readable after a kill -9, with schemas and metadata, though without an index.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import dump_qos_v9

from nss_ros import __version__
from nss_ros.errors import BagError
from nss_ros.topics import Topic
from nss_ros.typestore import jazzy_typestore

METADATA_NAME = "nss"
_FOREVER = QosTime(9223372036, 854775807)


@dataclass(slots=True)
class _Channel:
    id: int
    topic: str
    type: str
    digest: str
    qos: list[Any]
    count: int = field(default=0)


class BagWriter:
    """A bag being written; use as a context manager.

    Args:
        path: folder to create.
        chunk_size: bytes after which a chunk is compressed and written.
        compress: zstd, as opposed to no compression.

    Raises:
        BagError: the folder exists or cannot be created.
    """

    def __init__(self, path: Path, chunk_size: int = 1 << 20, compress: bool = True) -> None:
        self.path = path
        try:
            path.mkdir(parents=True)
            self._file = (path / f"{path.resolve().name}.mcap").open("xb")
        except FileExistsError as error:
            raise BagError(f"{path} exists already: choose another name or remove it.") from error
        except OSError as error:
            raise BagError(f"Cannot create the bag {path}: {error.strerror}.") from error
        compression = CompressionType.ZSTD if compress else CompressionType.NONE
        self._writer = Writer(self._file, chunk_size=chunk_size, compression=compression)
        self._writer.start(profile="ros2", library=f"nss_ros {__version__}")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._start = 2**63 - 1
        self._end = 0

    def add_metadata(self, values: Mapping[str, str]) -> None:
        """Store values, on disk at once. May be called again; later values win."""
        self._writer.add_metadata(METADATA_NAME, dict(values))
        self._file.flush()

    def add_topic(self, name: str, topic: Topic) -> None:
        """Announce a topic under its resolved name, with its schema and quality of service."""
        if name in self._channels:
            return
        store = jazzy_typestore()
        if topic.type not in self._schemas:
            definition, _ = store.generate_msgdef(topic.type, ros_version=2)
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, "ros2msg", definition.encode()
            )
        qos = dump_qos_v9([_qos(topic)])
        channel = self._writer.register_channel(
            name,
            "cdr",
            self._schemas[topic.type],
            {"offered_qos_profiles": yaml.safe_dump(qos, sort_keys=False)},
        )
        self._channels[name] = _Channel(
            channel, name, topic.type, store.hash_rihs01(topic.type), qos
        )

    def write(self, name: str, stamp: int, data: bytes) -> None:
        """Write one message of an announced topic as CDR bytes; `stamp` in nanoseconds."""
        channel = self._channels[name]
        self._writer.add_message(channel.id, stamp, data, stamp, channel.count)
        channel.count += 1
        self._start, self._end = min(self._start, stamp), max(self._end, stamp)

    def flush(self) -> None:
        """Hand everything so far to the operating system: it survives the process."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index and `metadata.yaml`."""
        information = self._information()
        text = yaml.safe_dump(information, sort_keys=False)
        self._writer.add_metadata("rosbag2", {"serialized_metadata": text})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        document = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        (self.path / "metadata.yaml").write_text(document)

    def abort(self) -> None:
        """Close without an index: what was flushed stays readable."""
        self._file.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _information(self) -> dict[str, Any]:
        count = sum(channel.count for channel in self._channels.values())
        span = {
            "starting_time": {"nanoseconds_since_epoch": self._start if count else 0},
            "duration": {"nanoseconds": self._end - self._start if count else 0},
            "message_count": count,
        }
        file_name = Path(self._file.name).name
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **span,
            "relative_file_paths": [file_name],
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": channel.topic,
                        "type": channel.type,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": channel.qos,
                        "type_description_hash": channel.digest,
                    },
                    "message_count": channel.count,
                }
                for channel in self._channels.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": file_name, **span}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


def _qos(topic: Topic) -> Qos:
    durability = QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE
    history = QosHistory.KEEP_LAST if topic.depth else QosHistory.KEEP_ALL
    return Qos(
        history=history,
        depth=topic.depth,
        reliability=QosReliability.RELIABLE,
        durability=durability,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )
