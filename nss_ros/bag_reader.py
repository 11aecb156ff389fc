"""Reading rosbag2 MCAP bags, closed properly or not.

Read record by record rather than through the index, so that a log whose recorder was killed
gives everything that had reached the disk.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from mcap.exceptions import McapError
from mcap.records import Channel, Footer, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader

from nss_ros.bag_writer import METADATA_NAME
from nss_ros.errors import BagError
from nss_ros.typestore import jazzy_typestore

# What a damaged record makes the parsers raise; everything before it counts.
_DAMAGE = (ValueError, KeyError, RuntimeError, MemoryError, OverflowError, struct.error)


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as it lies in the bag.

    Attributes:
        topic: resolved topic name.
        type: `pkg/msg/Name`.
        stamp: log time, nanoseconds.
        data: CDR bytes.
    """

    topic: str
    type: str
    stamp: int
    data: bytes


@dataclass(slots=True)
class BagReader:
    """A bag or log to be read.

    Attributes:
        path: folder, or a single `.mcap` file.
        partial: after `messages` ran to its end, whether a file is truncated or damaged, or was
            never closed.
        begin: after `messages` ran to its end, the earliest log time of any message, nanoseconds;
            0 if there is none.
        metadata: after `messages` ran to its end, the values stored with `add_metadata`.
    """

    path: Path
    partial: bool = False
    begin: int = 0
    metadata: dict[str, str] = field(default_factory=dict)

    def messages(self, types: Collection[str] | None = None) -> Iterator[RawMessage]:
        """All messages in the order of the file, of the given types only if given.

        Raises:
            BagError: there is no bag at `path`, or it is not MCAP, or holds foreign encodings.
        """
        for file in bag_files(self.path):
            yield from self._file_messages(file, types)

    def _file_messages(self, file: Path, types: Collection[str] | None) -> Iterator[RawMessage]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        complete = False
        for record in self._records(file):
            if isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:  # its announcement was lost
                    self.partial = True
                    continue
                self.begin = min(self.begin or record.log_time, record.log_time)
                schema = schemas.get(channel.schema_id)
                if schema is None or channel.message_encoding != "cdr":
                    continue
                if types is None or schema.name in types:
                    yield RawMessage(channel.topic, schema.name, record.log_time, record.data)
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata) and record.name == METADATA_NAME:
                self.metadata.update(record.metadata)
            elif isinstance(record, Footer):
                complete = True
        self.partial = self.partial or not complete

    def _records(self, file: Path) -> Iterator[Any]:
        with file.open("rb") as stream:
            try:
                yield from StreamReader(stream, validate_crcs=True).records
            except (McapError, CRCValidationError, EOFError):
                return
            except _DAMAGE:
                return


def bag_files(path: Path) -> list[Path]:
    """The MCAP files of a bag in order.

    Raises:
        BagError: there is none, or one is not MCAP.
    """
    files = [path] if path.is_file() else _folder_files(path)
    for file in files:
        with file.open("rb") as stream:
            magic = stream.read(8)
        if magic != b"\x89MCAP0\r\n":
            found = "is empty" if not magic else "is not an MCAP file"
            raise BagError(f"{file} {found}: expected a rosbag2 bag with MCAP storage.")
    return files


def bag_digest(path: Path) -> str:
    """SHA-256 of the MCAP files of a bag, by which a log recognises the bag that was played.

    Raises:
        BagError: there is no bag.
    """
    digest = hashlib.sha256()
    for file in bag_files(path):
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def read_metadata(path: Path) -> dict[str, str]:
    """The values that were stored in a bag with `add_metadata`.

    Raises:
        BagError: there is no bag.
    """
    reader = BagReader(path)
    for _ in reader.messages(()):
        pass
    return reader.metadata


def decode(message: RawMessage) -> Any:
    """The message as an object of rosbags' classes.

    Raises:
        BagError: its type is unknown, or its bytes do not fit the type.
    """
    store = jazzy_typestore()
    if message.type not in store.types:
        raise BagError(f"Topic {message.topic} has the type {message.type}, which nss_ros lacks.")
    try:
        return store.deserialize_cdr(message.data, message.type)
    except Exception as error:
        raise BagError(
            f"A message on {message.topic} is not a valid {message.type}: was it written with "
            "another version of nss_msgs?"
        ) from error


def encode(message: Any) -> bytes:
    """CDR bytes of a message of rosbags' classes."""
    return bytes(jazzy_typestore().serialize_cdr(message, message.__msgtype__))


def _folder_files(path: Path) -> list[Path]:
    if not path.exists():
        raise BagError(f"There is no bag at {path}: give the folder of a rosbag2 MCAP bag.")
    listed = _listed_files(path / "metadata.yaml")
    files = [path / name for name in listed] if listed else sorted(path.glob("*.mcap"))
    if not files:
        raise BagError(f"{path} holds no .mcap file: give the folder of a rosbag2 MCAP bag.")
    for file in files:
        if not file.is_file():
            raise BagError(f"{file} is missing, although {path}/metadata.yaml lists it.")
        if file.suffix != ".mcap":
            raise BagError(
                f"{file} is not MCAP: convert the bag with 'ros2 bag convert' (storage_id: mcap)."
            )
    return files


def _listed_files(path: Path) -> list[str]:
    try:
        information = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        return [str(name) for name in information["relative_file_paths"]]
    except (OSError, yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError):
        return []
