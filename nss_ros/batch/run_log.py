"""A run of a benchmark as a log, as the ROS graph would have recorded it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from nss_ros import topics
from nss_ros.bag import START_STAMP
from nss_ros.bag_reader import encode
from nss_ros.bag_writer import BagWriter
from nss_ros.batch.journal import Entry
from nss_ros.messages import (
    GraphProgress,
    fragment_poses_message,
    pair_message,
    pose_graph_message,
    rosbags_family,
)
from nss_ros.multiway.pose_graph import PoseGraph

_TOPICS = (topics.GROUND_TRUTH, topics.FRAGMENT_PAIRS, topics.RELATIVE_TRANSFORMS)
_MAP_TOPICS = (topics.POSE_GRAPH, topics.FRAGMENT_POSES)
_MAP_FRAME = "map"


def write_log(
    path: Path,
    begun: Path,
    ground_truth: Sequence[PoseGraph],
    entries: Sequence[Entry],
    map_: PoseGraph | None,
    metadata: Mapping[str, str],
) -> None:
    """Write a log; it appears whole or not at all, in place of what was there.

    Args:
        path: folder to create.
        begun: folder on the same disk where it is made.
        ground_truth: one graph per area.
        entries: one answer to each pair, in the order of the pairs.
        map_: of all areas; None: pairs only.
        metadata: of the run, with the bag that holds its point clouds.

    Raises:
        BagError: the folder cannot be written.
    """
    made = begun / path.name
    shutil.rmtree(made, ignore_errors=True)  # of a session that was killed
    with BagWriter(made) as writer:
        writer.add_metadata(metadata)
        _write(writer, ground_truth, entries, map_)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        old = begun / f"{path.name}.old"
        shutil.rmtree(old, ignore_errors=True)
        path.rename(old)
    made.rename(path)


def _write(
    writer: BagWriter,
    ground_truth: Sequence[PoseGraph],
    entries: Sequence[Entry],
    map_: PoseGraph | None,
) -> None:
    for topic in (*_TOPICS, *(_MAP_TOPICS if map_ is not None else ())):
        writer.add_topic(f"/{topic.name}", topic)
    family = rosbags_family()
    begin = min((entry.stamp for entry in entries), default=START_STAMP)
    for graph in ground_truth:
        message = pose_graph_message(graph, "ground_truth", begin, family)
        writer.write("/ground_truth", begin, encode(message))
    for entry in entries:
        message = pair_message(entry.result.pair, begin, family)
        writer.write("/fragment_pairs", begin, encode(message))
    # Not in the order of their stamps: resamplings of the score depend on the order of answers.
    for entry in entries:
        writer.write("/relative_transforms", entry.stamp, entry.data)
    if map_ is None:
        return
    end = max((entry.stamp for entry in entries), default=begin)
    progress = GraphProgress(len(entries), len(entries))
    graph_message = pose_graph_message(map_, _MAP_FRAME, end, family, progress)
    writer.write("/pose_graph", end, encode(graph_message))
    poses = fragment_poses_message(map_.nodes, _MAP_FRAME, end, family)
    writer.write("/fragment_poses", end, encode(poses))
