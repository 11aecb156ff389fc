"""A folder in the layout of the NSS challenge: point clouds and pose graphs that share them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from nss_ros.dataset.challenge import (
    ChallengeGraph,
    all_pairs,
    edge_pairs,
    fragment_ids,
    ground_truth,
    read_graphs,
)
from nss_ros.dataset.ply import read_ply
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, clean_points
from nss_ros.multiway.pose_graph import PoseGraph

METADATA_KEY = "challenge"

# Distance of a cloud from its origin, metres, from which single precision loses half a centimetre.
_FARTHEST = 50_000.0
# A scan of which half lies farther than this from its middle is not in metres; in centimetres it
# is not likely to be so wide as the second.
_WIDEST, _WIDEST_CENTIMETRES = 100.0, 1_000.0

_GRAPH_FOLDERS = ("pose_graph", "pose_graphs")
_POINT_FOLDERS = ("point_cloud", "point_clouds", "pointcloud", "pointclouds", ".")


class PairChoice(StrEnum):
    """Which pairs of a graph are to be registered."""

    AUTO = "auto"
    EDGES = "edges"
    ALL = "all"


@dataclass(frozen=True, slots=True)
class ChallengeFolder:
    """What a challenge folder gives to a bag.

    Attributes:
        graphs: as they stand in the files; each name once.
        ground_truth: the same graphs, checked, in the vocabulary of the core.
        pairs: union of the graphs' pairs, each two fragments once.
        point_files: the point cloud of every fragment of the graphs, in canonical order.
    """

    graphs: tuple[ChallengeGraph, ...]
    ground_truth: tuple[PoseGraph, ...]
    pairs: tuple[FragmentPair, ...]
    point_files: dict[FragmentId, Path]

    def metadata(self) -> dict[str, str]:
        """What an export needs beyond the fragments, for the bag: names, ids and edges.

        No pose and no relative transform: ground truth goes to its own topic only.
        """
        graphs = [
            {
                "name": graph.name,
                "nodes": [[node.id, node.name] for node in graph.nodes],
                "edges": None
                if graph.edges is None
                else [[edge.source, edge.target, edge.same_stage] for edge in graph.edges],
            }
            for graph in self.graphs
        ]
        return {METADATA_KEY: json.dumps(graphs)}


def read_folder(
    folder: Path, graph_pattern: str | None = None, pairs: PairChoice = PairChoice.AUTO
) -> ChallengeFolder:
    """Read and check a challenge folder; point clouds are located, not yet read.

    Args:
        folder: holds `point_cloud/*.ply` (or PLY files directly) and `pose_graph/**/*.json` (or
            JSON files directly).
        graph_pattern: shell pattern of the graphs to take, against the graph's name, the file's
            name with or without ending, or its path in the folder; None: all.
        pairs: the graphs' edges, all pairs of each graph's nodes, or (AUTO) the edges of graphs
            that have any and all pairs of the others.

    Raises:
        FormatError: a file, node or edge is not valid, or a point cloud is missing.
        InputError: there is no such folder, or no graph to take.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}: give a folder of the NSS challenge.")
    graphs = _selected_graphs(folder, graph_pattern)
    _check_names(graphs)
    return ChallengeFolder(
        graphs=tuple(graphs),
        ground_truth=tuple(ground_truth(graph) for graph in graphs),
        pairs=_union_of_pairs(graphs, pairs),
        point_files=_point_files(folder, graphs),
    )


def read_fragment(
    fragment_id: FragmentId, path: Path, gravity_aligned: bool
) -> tuple[Fragment, int]:
    """The fragment of a PLY file, and how many non-finite points it was cleaned of.

    Raises:
        FormatError: the file is not valid, holds no finite point, lies too far from its origin, or
            is not in metres.
    """
    with np.errstate(over="ignore"):
        vertices = read_ply(path)
        points = clean_points(vertices)
    if len(points) == 0:
        raise FormatError(
            f"{path} holds no finite point: replace it, or take its node out of the pose graph."
        )
    away = float(np.median(np.abs(points).max(axis=1)))
    if away > _FARTHEST:
        raise FormatError(
            f"{path} lies {away / 1000:.0f} km from the origin of its frame, where single "
            f"precision keeps {np.spacing(np.float32(away)) * 100:.1f} cm only: subtract an offset "
            "from its coordinates, for example that of the site."
        )
    reach = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    if reach > _WIDEST:
        unit, factor = (
            ("millimetres", 0.001) if reach > _WIDEST_CENTIMETRES else ("centimetres", 0.01)
        )
        raise FormatError(
            f"Half of {path} lies more than {reach:.0f} m from its middle: coordinates are taken "
            f"for metres, and these look like {unit}. Scale them by {factor}."
        )
    return Fragment(fragment_id, points, gravity_aligned), len(vertices) - len(points)


def find_points(folder: Path, name: str) -> Path | None:
    """The point cloud that a node names, with or without `.ply`; None if it is not there."""
    for candidate in (folder / name, folder / f"{name}.ply"):
        if candidate.is_file():
            return candidate
    return None


def _selected_graphs(folder: Path, pattern: str | None) -> list[ChallengeGraph]:
    files = _graph_files(folder)
    graphs = []
    for file in files:
        names = (file.name, file.stem, str(file.relative_to(folder)))
        if pattern is None or any(fnmatch(name, pattern) for name in names):
            graphs += read_graphs(file)
        else:
            graphs += [g for g in _graphs_or_none(file) if fnmatch(g.name, pattern)]
    if pattern is None and not any(graph.nodes for graph in graphs):
        raise InputError(f"The JSON files in {folder} hold no fragment: their lists are empty.")
    if not graphs:
        raise InputError(
            f"No pose graph in {folder} matches '{pattern}': its files are "
            f"{', '.join(str(file.relative_to(folder)) for file in files[:10])}"
            f"{', ...' if len(files) > 10 else ''}."
        )
    return graphs


def _graph_files(folder: Path) -> list[Path]:
    roots = [folder / name for name in _GRAPH_FOLDERS if (folder / name).is_dir()] or [folder]
    files = sorted(file for root in roots for file in root.rglob("*.json"))
    if not files:
        raise InputError(
            f"{folder} holds no pose graph: expected pose_graph/**/*.json as in the NSS challenge."
        )
    return files


def _graphs_or_none(file: Path) -> Iterator[ChallengeGraph]:
    # Its name was not asked for, so a file that is no pose graph does not matter.
    try:
        yield from read_graphs(file)
    except FormatError:
        return


def _check_names(graphs: Sequence[ChallengeGraph]) -> None:
    files: dict[str, str] = {}
    for graph in graphs:
        if graph.name in files:
            raise FormatError(
                f"The graph name {graph.name} occurs in {files[graph.name]} and in {graph.file}: "
                "rename one, or choose one of the files with --graph."
            )
        files[graph.name] = graph.file


def _union_of_pairs(
    graphs: Sequence[ChallengeGraph], choice: PairChoice
) -> tuple[FragmentPair, ...]:
    union: dict[frozenset[FragmentId], FragmentPair] = {}
    for graph in graphs:
        take_all = choice is PairChoice.ALL or (choice is PairChoice.AUTO and not graph.edges)
        for pair in all_pairs(graph) if take_all else edge_pairs(graph):
            union.setdefault(frozenset((pair.source, pair.target)), pair)
    return tuple(union.values())


def _point_files(folder: Path, graphs: Sequence[ChallengeGraph]) -> dict[FragmentId, Path]:
    folders = [folder / name for name in _POINT_FOLDERS if (folder / name).is_dir()]
    files: dict[FragmentId, Path] = {}
    for graph in graphs:
        fragments = fragment_ids(graph)
        for node in graph.nodes:
            name = node.name or str(fragments[node.id])
            found = (find_points(place, name) for place in folders)
            file = next((path for path in found if path is not None), None)
            if file is None:
                raise FormatError(
                    f"The point cloud {name} of node {node.id!r} of {graph} is missing: put it "
                    f"into {folder / _POINT_FOLDERS[0]}."
                )
            files[fragments[node.id]] = file
    return dict(sorted(files.items()))
