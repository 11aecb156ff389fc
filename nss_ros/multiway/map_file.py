"""Saving a map, and loading it back.

A path without an ending becomes a folder that holds everything (a rosbag2 MCAP bag with
fragments, relative transforms and the pose graph) and can be loaded; `.g2o`, `.tum` and `.ply`
are exports for other tools.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nss_ros import topics
from nss_ros.bag import START_STAMP, Log, read_log
from nss_ros.bag_reader import encode
from nss_ros.bag_writer import BagWriter
from nss_ros.dataset.trajectory import WRITERS
from nss_ros.errors import BagError, FormatError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.messages import (
    fragment_message,
    pose_graph_message,
    relative_transform_message,
    rosbags_family,
)
from nss_ros.multiway.multi_stage_map import EXCLUDED
from nss_ros.multiway.pose_graph import Edge, EdgeKind, PoseGraph
from nss_ros.registration.relative_transform import RelativeTransform


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map as it was saved.

    Attributes:
        fragments: by id.
        relative_transforms: answers by pair.
        constraints: edges given by a person.
        excluded: pairs that a person excluded.
        graph: the poses at the time of saving.
    """

    fragments: dict[FragmentId, Fragment]
    relative_transforms: dict[FragmentPair, RelativeTransform]
    constraints: tuple[Edge, ...]
    excluded: tuple[FragmentPair, ...]
    graph: PoseGraph


def save_map(
    path: Path,
    fragments: Mapping[FragmentId, Fragment],
    results: Mapping[FragmentPair, RelativeTransform],
    graph: PoseGraph,
) -> None:
    """Write a map to a folder, or to a file in the format that its ending names.

    Raises:
        BagError: the folder or file exists or cannot be written.
        FormatError: the ending names no format.
    """
    if path.suffix:
        _export(Log(path, False, dict(fragments), (), dict(results), (), graph))
        return
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


def _export(log: Log) -> None:
    writer = WRITERS.get(log.path.suffix)
    if writer is None:
        raise FormatError(
            f"{log.path} must end in {', '.join(WRITERS)}, or have no ending for a folder that "
            "can be loaded again."
        )
    if log.path.exists():
        raise BagError(f"{log.path} exists already: choose another name or remove it.")
    try:
        writer(log, log.path)
    except FormatError as error:
        raise BagError(str(error)) from error


def load_map(path: Path) -> SavedMap:
    """Read a map that `save_map` wrote, or the last state of a log.

    Raises:
        BagError: there is no bag.
        FormatError: the bag holds no pose graph, or lacks a fragment that a constraint names.
    """
    log = read_log(path)
    if log.pose_graph is None:
        raise FormatError(f"{path} holds no pose graph: give a saved map or the log of a run.")
    edges = log.pose_graph.edges
    constraints = tuple(edge for edge in edges if edge.kind is EdgeKind.MANUAL)
    for id_ in (id_ for edge in constraints for id_ in (edge.pair.source, edge.pair.target)):
        if id_ not in log.fragments:
            raise FormatError(
                f"{path} has a constraint on {id_} but not its points: give a saved map, or a log "
                "recorded with record_fragments."
            )
    return SavedMap(
        log.fragments,
        log.relative_transforms,
        constraints,
        tuple(edge.pair for edge in edges if edge.reason == EXCLUDED),
        log.pose_graph,
    )
