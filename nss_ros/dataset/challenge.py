"""The pose graphs of the NSS challenge: JSON, in the field names of 2024 and of 2025.

The challenge's terms in ours: a node is a fragment with its pose `global_transform`
(2024: `tsfm`), the zero matrix marks an outlier; an edge's `relative_transform` (2024: `tsfm`)
is `T_target_source`. Source: README of the official evaluator,
https://nothing-stands-still.com/challenge.

Graphs are read as they are, so that the scorer sees every digit and every omission;
`ground_truth` turns a graph into the vocabulary of the core and checks it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from nss_ros.errors import FormatError, InputError
from nss_ros.files import write_file
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, as_transform, is_transform, relative
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph

NodeId = int | str

# Those of 2024 in place of those of 2025.
_NODE_NAMES_2024 = {"global_transform": "tsfm"}
_EDGE_NAMES_2024 = {
    "source_id": "source",
    "target_id": "target",
    "relative_transform": "tsfm",
    "overlap_ratio": "overlap",
}


@dataclass(frozen=True, slots=True)
class ChallengeNode:
    """A node as it stands in a file.

    Attributes:
        id: as in the file; `1` and `"1"` differ.
        name: point cloud file; None where the file gives none (predictions).
        transform: (4, 4) pose, the zero matrix for an outlier; None where there is none.
        anchor: flagged as the node whose ground-truth pose fixes the frame.
        labels: the fields `building`, `stage` and `spot`, as far as given.
        points: number of points of the point cloud; None where the file does not say.
    """

    id: NodeId
    name: str | None = None
    transform: Transform | None = None
    anchor: bool = False
    labels: tuple[tuple[str, str], ...] = ()
    points: int | None = None

    @property
    def outlier(self) -> bool:
        """Whether the pose is the zero matrix."""
        return self.transform is not None and not self.transform.any()


@dataclass(frozen=True, slots=True)
class ChallengeEdge:
    """An edge as it stands in a file.

    Attributes:
        source: node id.
        target: node id.
        transform: (4, 4) `T_target_source`; None where there is none.
        same_stage: None where the file does not say.
        overlap_ratio: NaN when unknown.
        temporal_change: NaN when unknown.
    """

    source: NodeId
    target: NodeId
    transform: Transform | None = None
    same_stage: bool | None = None
    overlap_ratio: float = float("nan")
    temporal_change: float = float("nan")


@dataclass(frozen=True, slots=True)
class ChallengeGraph:
    """A pose graph as it stands in a file.

    Attributes:
        name: of the graph, or of the file where it has none.
        nodes: in the order of the file.
        edges: in the order of the file; None where the file has no list of edges.
        file: where it was read from, for messages.
    """

    name: str
    nodes: tuple[ChallengeNode, ...]
    edges: tuple[ChallengeEdge, ...] | None = None
    file: str = ""

    def __str__(self) -> str:
        return f"graph {self.name} in {self.file}" if self.file else f"graph {self.name}"


def read_graphs(path: Path) -> list[ChallengeGraph]:
    """The graphs of a JSON file that holds one graph or a list of graphs.

    Raises:
        FormatError: the file cannot be read, or is not made of graphs.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise FormatError(f"Cannot read pose graphs {path}: {error.strerror}.") from error
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path} is not valid JSON: {error}.") from error
    graphs = content if isinstance(content, list) else [content]
    return [
        _graph(graph, str(path), path.stem if len(graphs) == 1 else f"{path.stem}_{i}")
        for i, graph in enumerate(graphs)
    ]


def write_graphs(path: Path, graphs: Sequence[ChallengeGraph]) -> None:
    """Write graphs as a list in the field names of 2025, as the challenge's server takes them.

    Raises:
        FormatError: the file cannot be written.
    """
    write_file(path, json.dumps([_graph_fields(graph) for graph in graphs]).encode())


def write_graphs_2024(path: Path, graphs: Sequence[ChallengeGraph]) -> None:
    """Write graphs as a list in the field names of 2024, as the release's multi-way annotations.

    Raises:
        FormatError: the file cannot be written.
    """
    write_file(path, (json.dumps([_graph_fields_2024(graph) for graph in graphs]) + "\n").encode())


def write_graph(path: Path, graph: ChallengeGraph) -> None:
    """Write one graph in the field names of 2025 and with its size, as the release has them.

    Raises:
        FormatError: the file cannot be written.
    """
    fields = _graph_fields(graph)
    fields = {"name": fields.pop("name"), "size": len(graph.nodes)} | fields
    write_file(path, (json.dumps(fields, indent=1) + "\n").encode())


def fragment_ids(graph: ChallengeGraph) -> dict[NodeId, FragmentId]:
    """The fragment of every node, in the order of the graph.

    Raises:
        FormatError: a node has no valid name, its labels contradict the name, or an id or a name
            occurs twice.
    """
    ids: dict[NodeId, FragmentId] = {}
    nodes_by_fragment: dict[FragmentId, NodeId] = {}
    for node in graph.nodes:
        if node.id in ids:
            raise FormatError(f"Node id {node.id!r} occurs twice in {graph}: ids must be unique.")
        fragment = _fragment_id(node, graph)
        if fragment in nodes_by_fragment:
            raise FormatError(
                f"Nodes {nodes_by_fragment[fragment]!r} and {node.id!r} of {graph} have the same "
                f"name {node.name}: name one point cloud each."
            )
        ids[node.id] = fragment
        nodes_by_fragment[fragment] = node.id
    return ids


def ground_truth(graph: ChallengeGraph) -> PoseGraph:
    """A graph in the vocabulary of the core, checked.

    Nodes with the zero matrix are OUTLIER, nodes without a pose UNPLACED. An edge without a
    transform gets that of its nodes' poses, and is left out where they have none.

    Raises:
        FormatError: naming the node or edge that is not valid.
    """
    ids = fragment_ids(graph)
    nodes = tuple(_ground_truth_node(node, ids[node.id], graph) for node in graph.nodes)
    poses = {node.id: node.T_map_fragment for node in nodes if node.status is NodeStatus.PLACED}
    edges = []
    for edge in graph.edges or ():
        pair = _edge_pair(edge, ids, graph)
        transform = _edge_transform(edge, pair, poses, graph)
        if transform is not None:
            same = pair.same_stage if edge.same_stage is None else edge.same_stage
            kind = EdgeKind.SAME_STAGE if same else EdgeKind.DIFFERENT_STAGE
            edges.append(
                Edge(
                    pair,
                    transform,
                    kind,
                    overlap_ratio=edge.overlap_ratio,
                    temporal_change=edge.temporal_change,
                )
            )
    return PoseGraph(nodes, tuple(edges), graph.name)


def edge_pairs(graph: ChallengeGraph) -> list[FragmentPair]:
    """The pairs of the graph's edges, in the graph's order and directions.

    Raises:
        FormatError: as `ground_truth`.
    """
    ids = fragment_ids(graph)
    return [_edge_pair(edge, ids, graph) for edge in graph.edges or ()]


def all_pairs(graph: ChallengeGraph) -> list[FragmentPair]:
    """Every two nodes of the graph once, the earlier fragment as source.

    Raises:
        FormatError: as `fragment_ids`.
    """
    fragments = sorted(fragment_ids(graph).values())
    return [FragmentPair(source, target) for source, target in combinations(fragments, 2)]


def _graph(data: Any, file: str, default_name: str) -> ChallengeGraph:
    if not isinstance(data, dict) or not isinstance(data.get("nodes"), list):
        raise FormatError(
            f"{file} is not a pose graph of the NSS challenge: expected an object with a list "
            "'nodes', or a list of such objects."
        )
    name = data.get("name", default_name)
    place = f"graph {name} in {file}"
    edges = data.get("edges")
    if edges is not None and not isinstance(edges, list):
        raise FormatError(f"'edges' of {place} must be a list.")
    return ChallengeGraph(
        name=str(name).encode(errors="replace").decode(),  # JSON may hold half a character
        nodes=tuple(_node(node, place) for node in data["nodes"]),
        edges=None if edges is None else tuple(_edge(edge, place) for edge in edges),
        file=file,
    )


def _node(data: Any, place: str) -> ChallengeNode:
    if not isinstance(data, dict):
        raise FormatError(f"A node of {place} is not an object.")
    node_id = _node_id(data, "id", place)
    name = data.get("name")
    if name is not None and not isinstance(name, str):
        raise FormatError(f"The name of node {node_id!r} of {place} is not a text.")
    keys = ("building", "stage", "spot")
    return ChallengeNode(
        id=node_id,
        name=name,
        transform=_matrix(_either(data, "global_transform", "tsfm"), f"node {node_id!r}", place),
        anchor=data.get("anchor") in (True, 1),
        labels=tuple((key, str(data[key])) for key in keys if data.get(key) is not None),
        points=_count(data.get("points"), node_id, place),
    )


def _count(value: Any, node_id: NodeId, place: str) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise FormatError(f"'points' of node {node_id!r} of {place} is not a count: {value!r}.")
    return value


def _edge(data: Any, place: str) -> ChallengeEdge:
    if not isinstance(data, dict):
        raise FormatError(f"An edge of {place} is not an object.")
    source = _node_id(data, "source_id", place, "source")
    target = _node_id(data, "target_id", place, "target")
    what = f"edge {source!r} -> {target!r}"
    same_stage = data.get("same_stage")
    if same_stage not in (None, True, False):
        raise FormatError(f"'same_stage' of {what} of {place} must be true or false.")
    return ChallengeEdge(
        source=source,
        target=target,
        transform=_matrix(_either(data, "relative_transform", "tsfm"), what, place),
        same_stage=None if same_stage is None else bool(same_stage),
        overlap_ratio=_ratio(_either(data, "overlap_ratio", "overlap"), what, place),
        temporal_change=_ratio(data.get("temporal_change"), what, place),
    )


def _either(data: dict[str, Any], name: str, name_2024: str) -> Any:
    # A null under the new name hides the old one, as it does in the official evaluator.
    return data[name] if name in data else data.get(name_2024)


def _node_id(data: dict[str, Any], key: str, place: str, key_2024: str = "id") -> NodeId:
    value = _either(data, key, key_2024)
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, bool) or not isinstance(value, int | str):
        what = "A node" if key == "id" else "An edge"
        raise FormatError(f"{what} of {place} needs a number or a text as '{key}', not {value!r}.")
    return value


def _matrix(value: Any, what: str, place: str) -> Transform | None:
    if value is None:
        return None
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4):
        raise FormatError(f"The transform of {what} of {place} is not a 4x4 matrix of numbers.")
    return matrix


def _ratio(value: Any, what: str, place: str) -> float:
    if value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FormatError(f"A ratio of {what} of {place} is not a number: {value!r}.")
    try:
        return float(value)
    except OverflowError as error:
        raise FormatError(f"A ratio of {what} of {place} is too large.") from error


def _fragment_id(node: ChallengeNode, graph: ChallengeGraph) -> FragmentId:
    if node.name is None:
        raise FormatError(
            f"Node {node.id!r} of {graph} has no name: it must name its point cloud, for example "
            "Bldg1_Stage2_Spot14.ply."
        )
    try:
        fragment = FragmentId.parse(node.name)
    except InputError as error:
        raise FormatError(f"The name of node {node.id!r} of {graph} is not usable: {error}") from (
            error
        )
    said = {"building": fragment.area, "stage": str(fragment.stage), "spot": str(fragment.spot)}
    for key, label in node.labels:
        if label != said[key]:
            raise FormatError(
                f"Node {node.id!r} of {graph} is named {node.name}, but its {key} is {label}: "
                "make them agree."
            )
    return fragment


def _ground_truth_node(node: ChallengeNode, fragment: FragmentId, graph: ChallengeGraph) -> Node:
    if node.transform is None:
        return Node(fragment, status=NodeStatus.UNPLACED)
    if node.outlier:
        return Node(fragment, status=NodeStatus.OUTLIER)
    pose = _rigid(node.transform, f"The pose of node {node.id!r} of {graph}")
    return Node(fragment, pose, NodeStatus.PLACED)


def _edge_pair(
    edge: ChallengeEdge, ids: Mapping[NodeId, FragmentId], graph: ChallengeGraph
) -> FragmentPair:
    for node_id in (edge.source, edge.target):
        if node_id not in ids:
            raise FormatError(
                f"Edge {edge.source!r} -> {edge.target!r} of {graph} names the node {node_id!r}, "
                "which the graph does not have."
            )
    if edge.source == edge.target:
        raise FormatError(f"An edge of {graph} links node {edge.source!r} to itself.")
    return FragmentPair(ids[edge.source], ids[edge.target])


def _edge_transform(
    edge: ChallengeEdge,
    pair: FragmentPair,
    poses: Mapping[FragmentId, Transform],
    graph: ChallengeGraph,
) -> Transform | None:
    if edge.transform is not None:
        what = f"The transform of edge {edge.source!r} -> {edge.target!r} of {graph}"
        return _rigid(edge.transform, what)
    if pair.source in poses and pair.target in poses:
        return relative(poses[pair.source], poses[pair.target])
    return None


def _rigid(matrix: Transform, what: str) -> Transform:
    if not is_transform(matrix):
        raise FormatError(
            f"{what} is not rigid: expected a finite rotation and translation with the last row "
            "0 0 0 1."
        )
    return as_transform(matrix, what)


def _graph_fields(graph: ChallengeGraph) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "name": graph.name,
        "nodes": [_node_fields(node) for node in graph.nodes],
    }
    if graph.edges is not None:
        fields["edges"] = [_edge_fields(edge) for edge in graph.edges]
    return fields


def _graph_fields_2024(graph: ChallengeGraph) -> dict[str, Any]:
    nodes = []
    for node in graph.nodes:
        fields = _node_fields(node) | dict(node.labels)  # texts, not numbers
        nodes.append({_NODE_NAMES_2024.get(name, name): v for name, v in fields.items()})
    edges = [
        {_EDGE_NAMES_2024.get(name, name): value for name, value in _edge_fields(edge).items()}
        for edge in graph.edges or ()
    ]
    return {"name": graph.name, "nodes": nodes, "edges": edges}


def _node_fields(node: ChallengeNode) -> dict[str, Any]:
    fields: dict[str, Any] = {"id": node.id}
    if node.name is not None:
        fields["name"] = node.name
    for key, label in node.labels:
        fields[key] = int(label) if label.isdecimal() and str(int(label)) == label else label
    if node.points is not None:
        fields["points"] = node.points
    if node.transform is not None:
        fields["global_transform"] = node.transform.tolist()
    if node.anchor:
        fields["anchor"] = True
    return fields


def _edge_fields(edge: ChallengeEdge) -> dict[str, Any]:
    fields: dict[str, Any] = {"source_id": edge.source, "target_id": edge.target}
    if edge.transform is not None:
        fields["relative_transform"] = edge.transform.tolist()
    for name in ("overlap_ratio", "temporal_change"):
        if math.isfinite(ratio := getattr(edge, name)):
            fields[name] = ratio
    if edge.same_stage is not None:
        fields["same_stage"] = edge.same_stage
    return fields
