"""Results as they come, append-only: what was written before a kill -9 is there afterwards.

    journal/0001/0001.mcap    one MCAP per session, one topic /<method>/relative_transforms per
    journal/0002/0002.mcap    method; a session that was killed has no index and perhaps half a
                              record at its end, which is dropped

MCAP cannot be continued once it was cut, so every session of a benchmark begins a file of its own;
each result is flushed by itself. A pair that two sessions answered keeps its first answer, unless
that is only that its worker died: a killed process says as much of the machine, and of what else
ran there, as of the pair, so a later session tries again. The seconds of preparing a fragment are
metadata records of the same files.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from nss_ros import topics
from nss_ros.bag_reader import BagReader, decode, encode
from nss_ros.bag_writer import BagWriter
from nss_ros.errors import BagError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.messages import relative_transform_from, relative_transform_message, rosbags_family
from nss_ros.registration.relative_transform import Reason, RelativeTransform

_PREPARE = "prepare_seconds"


@dataclass(frozen=True, slots=True)
class Entry:
    """A result as it was written.

    Attributes:
        stamp: when it was there, nanoseconds since the epoch.
        data: CDR bytes of the message.
        result: what the message says: a session that goes on has the same numbers, to the bit,
            as one that was never interrupted, and as the nodes of a graph.
    """

    stamp: int
    data: bytes
    result: RelativeTransform

    @property
    def final(self) -> bool:
        """Whether no later session tries again."""
        return self.result.reason is not Reason.WORKER_DIED


class Journal:
    """The results of all sessions of a benchmark; use as a context manager or close it.

    Args:
        folder: of the sessions; made when something is added.

    Attributes:
        entries: by method and pair.
        prepare_seconds: by method and fragment.

    Raises:
        BagError: a file is not a journal.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: BagWriter | None = None
        self.entries: dict[str, dict[FragmentPair, Entry]] = {}
        self.prepare_seconds: dict[str, dict[FragmentId, float]] = {}
        sessions = sorted(folder.glob("[0-9]*/*.mcap"))
        for file in sessions:
            self._read(file)
        numbers = [int(each.name) for each in folder.glob("[0-9]*") if each.name.isdigit()]
        self._number = max(numbers, default=0) + 1

    def of(self, method: str) -> dict[FragmentPair, Entry]:
        """The results of a method."""
        return self.entries.setdefault(method, {})

    def add(self, method: str, result: RelativeTransform) -> None:
        """Write a result: it is handed to the operating system when this returns."""
        stamp = time.time_ns()
        topic = _topic(method)
        writer = self._open()
        writer.add_topic(topic, topics.RELATIVE_TRANSFORMS)
        message = relative_transform_message(result, stamp, rosbags_family())
        data = encode(message)
        writer.write(topic, stamp, data)
        writer.flush()
        self.of(method)[result.pair] = Entry(stamp, data, relative_transform_from(message))

    def add_preparation(self, method: str, fragment: FragmentId, seconds: float) -> None:
        """Note how long the features of a fragment took."""
        self._open().add_metadata({f"{_PREPARE}/{method}/{fragment}": repr(seconds)})
        self.prepare_seconds.setdefault(method, {})[fragment] = seconds

    def close(self) -> None:
        """Write the index of this session's file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> BagWriter:
        if self._writer is None:
            self._writer = BagWriter(self._folder / f"{self._number:04d}")
        return self._writer

    def _read(self, file: Path) -> None:
        if file.stat().st_size < 8:  # killed before anything was written
            return
        reader = BagReader(file)
        for raw in reader.messages({topics.RELATIVE_TRANSFORMS.type}):
            method = raw.topic.removeprefix("/").removesuffix(f"/{topics.RELATIVE_TRANSFORMS.name}")
            result = relative_transform_from(decode(raw))
            entries = self.of(method)
            if result.pair not in entries or not entries[result.pair].final:
                entries[result.pair] = Entry(raw.stamp, raw.data, result)
        for name, value in reader.metadata.items():
            if not name.startswith(f"{_PREPARE}/"):
                raise BagError(f"{file} is not a journal of 'nss benchmark': remove it.")
            method, fragment = name.removeprefix(f"{_PREPARE}/").rsplit("/", 1)
            seconds = self.prepare_seconds.setdefault(method, {})
            seconds[FragmentId.parse(fragment)] = float(value)


def _topic(method: str) -> str:
    return f"/{method}/{topics.RELATIVE_TRANSFORMS.name}"
