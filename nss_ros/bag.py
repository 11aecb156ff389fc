"""Bags and logs with the vocabulary of the core: fragments, pairs, transforms, pose graphs.

A bag is what is replayed; a log is what a run recorded. Both are rosbag2 MCAP. Ground truth
lies on its own topic, which only the recorder and the scorer read: no node that estimates
subscribes to it.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from nss_ros import topics
from nss_ros.bag_reader import BagReader, RawMessage, bag_digest, decode, encode
from nss_ros.bag_writer import BagWriter
from nss_ros.errors import BagError, InputError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.messages import (
    fragment_from,
    fragment_message,
    pair_from,
    pair_message,
    pose_graph_from,
    pose_graph_message,
    relative_transform_from,
    rosbags_family,
)
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.registration.relative_transform import RelativeTransform

# Datasets give no time of day; a fixed start keeps bags reproducible and stamps away from zero.
START_STAMP = 1_700_000_000 * 10**9

_TYPES = {
    topic.type
    for topic in (
        topics.FRAGMENTS,
        topics.FRAGMENT_PAIRS,
        topics.RELATIVE_TRANSFORMS,
        topics.POSE_GRAPH,
    )
}


@dataclass(slots=True)
class Arrivals:
    """When the messages of a log came, nanoseconds by the recorder's clock.

    Attributes:
        begin: of the first message of any kind; 0 if there is none.
        fragments: of every fragment; empty if it was read without points.
        pairs: of the first request for each pair.
        relative_transforms: of the first answer to each pair.
    """

    begin: int = 0
    fragments: list[int] = field(default_factory=list)
    pairs: dict[FragmentPair, int] = field(default_factory=dict)
    relative_transforms: dict[FragmentPair, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Log:
    """A bag or a recorded log, decoded.

    Attributes:
        path: where it was read from.
        partial: it is truncated or was never closed.
        fragments: by id, in the order of first appearance.
        pairs: pairs asked for, each once, in order.
        relative_transforms: the first answer to each pair.
        ground_truth: one pose graph per graph of the dataset.
        pose_graph: the last one published; None if none was.
        metadata: of the run and of the bags that were replayed.
        arrivals: when what came.
    """

    path: Path
    partial: bool = False
    fragments: dict[FragmentId, Fragment] = field(default_factory=dict)
    pairs: tuple[FragmentPair, ...] = ()
    relative_transforms: dict[FragmentPair, RelativeTransform] = field(default_factory=dict)
    ground_truth: tuple[PoseGraph, ...] = ()
    pose_graph: PoseGraph | None = None
    metadata: dict[str, str] = field(default_factory=dict)
    arrivals: Arrivals = field(default_factory=Arrivals)


def write_bag(
    path: Path,
    fragments: Iterable[Fragment],
    pairs: Sequence[FragmentPair],
    ground_truth: Sequence[PoseGraph] = (),
    metadata: Mapping[str, str] | None = None,
    period: float = 0.5,
) -> None:
    """Write a bag: ground truth first, then each fragment followed by the pairs it completes.

    Args:
        path: folder to create.
        fragments: in the order of recording.
        pairs: each is written once both of its fragments are.
        ground_truth: one pose graph per graph of the dataset.
        metadata: how the bag was made.
        period: seconds of bag time between fragments.

    Raises:
        BagError: the folder exists or cannot be written, an id occurs twice, or a pair names a
            fragment that is not there.
    """
    writer = BagWriter(path)
    try:
        with writer:
            writer.add_metadata(metadata or {})
            _write_content(writer, fragments, pairs, ground_truth, round(period * 1e9))
    except BaseException:
        shutil.rmtree(path)  # our own half-written folder: BagWriter refuses an existing one
        raise


def _write_content(
    writer: BagWriter,
    fragments: Iterable[Fragment],
    pairs: Sequence[FragmentPair],
    ground_truth: Sequence[PoseGraph],
    period: int,
) -> None:
    for topic in (topics.GROUND_TRUTH, topics.FRAGMENTS, topics.FRAGMENT_PAIRS):
        writer.add_topic(f"/{topic.name}", topic)
    family = rosbags_family()
    stamp = START_STAMP
    for graph in ground_truth:
        message = pose_graph_message(graph, "ground_truth", stamp, family)
        writer.write("/ground_truth", stamp, encode(message))
    written: set[FragmentId] = set()
    waiting = list(dict.fromkeys(pairs))
    for fragment in fragments:
        if fragment.id in written:
            raise BagError(f"Fragment {fragment.id} occurs twice: ids must be unique in a bag.")
        written.add(fragment.id)
        writer.write("/fragments", stamp, encode(fragment_message(fragment, stamp, family)))
        ready = [p for p in waiting if p.source in written and p.target in written]
        waiting = [p for p in waiting if p.source not in written or p.target not in written]
        for pair in ready:
            writer.write("/fragment_pairs", stamp, encode(pair_message(pair, stamp, family)))
        stamp += period
    if waiting:
        raise BagError(f"Pair {waiting[0]} names a fragment that is not among the fragments.")


def read_log(path: Path | str, points: bool = True) -> Log:
    """Read a bag or log whole.

    Args:
        path: folder of a rosbag2 MCAP bag, or one `.mcap` file.
        points: read the point clouds too; they are most of a log.

    Raises:
        BagError: there is no bag, or it holds nothing of nss_ros, or a message is not valid.
    """
    path = Path(path)
    reader = BagReader(path)
    wanted = _TYPES if points else _TYPES - {topics.FRAGMENTS.type}
    content = _Content()
    for message in reader.messages(wanted):
        try:
            content.add(message)
        except InputError as error:
            raise BagError(f"{path}, topic {message.topic}: {error}") from error
    if not content.any and not reader.metadata:
        raise BagError(
            f"{path} holds no message of nss_msgs: make a bag with 'nss import' or 'nss simulate'."
        )
    return Log(
        path=path,
        partial=reader.partial,
        fragments=content.fragments,
        pairs=tuple(content.pairs),
        relative_transforms=content.relative_transforms,
        ground_truth=tuple(content.ground_truth.values()),
        pose_graph=content.pose_graph,
        metadata=reader.metadata,
        arrivals=replace(content.arrivals, begin=reader.begin),
    )


def with_source_points(log: Log) -> Log:
    """A log that was recorded without point clouds, with those of the bags that were played.

    Paths of bags that are relative to the log's folder move with it. Bags that moved or changed
    since (their hash tells) are left out: the log then stays without.

    Raises:
        BagError: a bag is there, unchanged, and yet cannot be read.
    """
    fragments = dict(log.fragments)
    number = 0
    while not log.fragments and (name := log.metadata.get(f"bag_{number}")):
        bag = Path(name) if Path(name).exists() else log.path / name
        if bag.exists() and bag_digest(bag) == log.metadata.get(f"bag_{number}_sha256"):
            fragments |= read_log(bag).fragments
        number += 1
    return replace(log, fragments=fragments)


@dataclass(slots=True)
class _Content:
    any: bool = False
    fragments: dict[FragmentId, Fragment] = field(default_factory=dict)
    pairs: dict[FragmentPair, None] = field(default_factory=dict)
    relative_transforms: dict[FragmentPair, RelativeTransform] = field(default_factory=dict)
    ground_truth: dict[str, PoseGraph] = field(default_factory=dict)
    pose_graph: PoseGraph | None = None
    arrivals: Arrivals = field(default_factory=Arrivals)

    def add(self, raw: RawMessage) -> None:
        self.any = True
        message = decode(raw)
        if raw.type == topics.FRAGMENTS.type:
            fragment = fragment_from(message)
            self.fragments.setdefault(fragment.id, fragment)
            self.arrivals.fragments.append(raw.stamp)
        elif raw.type == topics.FRAGMENT_PAIRS.type:
            pair = pair_from(message)
            self.pairs[pair] = None
            self.arrivals.pairs.setdefault(pair, raw.stamp)
        elif raw.type == topics.RELATIVE_TRANSFORMS.type:
            result = relative_transform_from(message)
            self.relative_transforms.setdefault(result.pair, result)
            self.arrivals.relative_transforms.setdefault(result.pair, raw.stamp)
        elif raw.topic.rsplit("/", 1)[-1] == topics.GROUND_TRUTH.name:
            graph = pose_graph_from(message)
            self.ground_truth[graph.name] = graph
        else:
            self.pose_graph = pose_graph_from(message)
