"""Saving a map, and loading it back.

A folder holds everything (a rosbag2 MCAP bag with fragments, relative transforms and the pose
graph) and can be loaded; file endings name export formats.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nss_ros import topics
from nss_ros.bag import START_STAMP, read_log
from nss_ros.bag_reader import encode
from nss_ros.bag_writer import BagWriter
from nss_ros.errors import FormatError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import Transform
from nss_ros.messages import (
    fragment_message,
    pose_graph_message,
    relative_transform_message,
    rosbags_family,
)
from nss_ros.multiway.pose_graph import EdgeKind, PoseGraph
from nss_ros.registration.relative_transform import RelativeTransform


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map as it was saved.

    Attributes:
        fragments: by id.
        relative_transforms: answers by pair.
        constraints: `T_target_source` given by a person, by pair.
        graph: the poses at the time of saving.
    """

    fragments: dict[FragmentId, Fragment]
    relative_transforms: dict[FragmentPair, RelativeTransform]
    constraints: dict[FragmentPair, Transform]
    graph: PoseGraph


def save_map(
    path: Path,
    fragments: Mapping[FragmentId, Fragment],
    results: Mapping[FragmentPair, RelativeTransform],
    graph: PoseGraph,
) -> None:
    """Write a map to a folder.

    Raises:
        BagError: the folder exists or cannot be written.
    """
    family = rosbags_family()
    with BagWriter(path) as writer:
        for topic in (topics.FRAGMENTS, topics.RELATIVE_TRANSFORMS, topics.POSE_GRAPH):
            writer.add_topic(f"/{topic.name}", topic)
        for id_ in sorted(fragments):
            message = fragment_message(fragments[id_], START_STAMP, family)
            writer.write("/fragments", START_STAMP, encode(message))
        for pair in sorted(results):
            answer = relative_transform_message(results[pair], START_STAMP, family)
            writer.write("/relative_transforms", START_STAMP, encode(answer))
        message = pose_graph_message(graph, "map", START_STAMP, family)
        writer.write("/pose_graph", START_STAMP, encode(message))


def load_map(path: Path) -> SavedMap:
    """Read a map that `save_map` wrote, or the last state of a log.

    Raises:
        BagError: there is no bag.
        FormatError: the bag holds no pose graph.
    """
    log = read_log(path)
    if log.pose_graph is None:
        raise FormatError(f"{path} holds no pose graph: give a saved map or the log of a run.")
    constraints = {
        edge.pair: edge.T_target_source
        for edge in log.pose_graph.edges
        if edge.kind is EdgeKind.MANUAL
    }
    return SavedMap(log.fragments, log.relative_transforms, constraints, log.pose_graph)
