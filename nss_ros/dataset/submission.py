"""A map as a submission to the NSS challenge."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import permutations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nss_ros.bag import Log
from nss_ros.dataset.challenge import ChallengeEdge, ChallengeGraph, ChallengeNode
from nss_ros.dataset.challenge_folder import METADATA_KEY
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import relative
from nss_ros.multiway.pose_graph import EdgeStatus, PoseGraph


def submission(log: Log) -> list[ChallengeGraph]:
    """The log's map as one graph per graph of the imported folder.

    Each graph has the node ids, names and edges of its source. Fragments outside the graph's
    main component are outliers: the zero matrix. The first placed node is flagged as `anchor`.
    Edges link placed nodes, with relative transforms computed from the poses; a graph whose
    source has no edges gets none when all its nodes are placed (the evaluator then computes them
    from the poses), else all pairs of placed nodes in both directions, because it would refuse to
    invert the zero matrix.

    Raises:
        InputError: the log holds no pose graph.
        FormatError: the log's challenge metadata is damaged.
    """
    if log.pose_graph is None:
        raise InputError(f"{log.path} holds no pose graph: map the bag first with 'nss map'.")
    return [placed_graph(template, log.pose_graph) for template in templates(log)]


def templates(log: Log) -> list[ChallengeGraph]:
    """The graphs that a log answers, without transforms: those of the imported folder.

    For a bag that was not imported, one graph per ground-truth graph, or one of all fragments.

    Raises:
        FormatError: the log's challenge metadata is damaged.
    """
    if METADATA_KEY in log.metadata:
        try:
            graphs = json.loads(log.metadata[METADATA_KEY])
            return [_template(**graph) for graph in graphs]
        except (ValueError, TypeError) as error:
            raise FormatError(
                f"The metadata '{METADATA_KEY}' of {log.path} is damaged: import the folder again."
            ) from error
    if log.ground_truth:
        return [template_of(graph) for graph in log.ground_truth]
    ids = [node.id for node in log.pose_graph.nodes] if log.pose_graph else []
    return [_numbered(log.path.stem, ids)]


def template_of(graph: PoseGraph) -> ChallengeGraph:
    """A core graph as a challenge graph without transforms, its nodes numbered from 0."""
    ids = [node.id for node in graph.nodes]
    numbers = {fragment: number for number, fragment in enumerate(ids)}
    edges = tuple(
        ChallengeEdge(
            numbers[edge.pair.source], numbers[edge.pair.target], same_stage=edge.pair.same_stage
        )
        for edge in graph.edges
    )
    return ChallengeGraph(graph.name, _numbered("", ids).nodes, edges or None)


def placed_graph(template: ChallengeGraph, pose_graph: PoseGraph) -> ChallengeGraph:
    """A graph of the challenge with the poses of a map; see `submission`."""
    ids = {node.id: FragmentId.parse(node.name or "") for node in template.nodes}
    components = accepted_components(pose_graph, list(ids.values()))
    main = set(components[0]) if components else set()
    placed = pose_graph.poses()
    poses = {key: placed[id_].T_map_fragment for key, id_ in ids.items() if id_ in main}
    anchor = next(iter(poses), None)
    nodes = tuple(
        ChallengeNode(
            node.id, node.name, poses.get(node.id, np.zeros((4, 4))), anchor=node.id == anchor
        )
        for node in template.nodes
    )
    edges = _template_edges(template, ids, complete=len(poses) == len(ids))
    if edges is None:
        return ChallengeGraph(template.name, nodes)
    return ChallengeGraph(
        template.name,
        nodes,
        tuple(
            ChallengeEdge(
                edge.source,
                edge.target,
                relative(poses[edge.source], poses[edge.target]),
                edge.same_stage,
            )
            for edge in edges
            if edge.source in poses and edge.target in poses
        ),
    )


def accepted_components(
    pose_graph: PoseGraph, fragments: Sequence[FragmentId]
) -> list[list[FragmentId]]:
    """The components that accepted edges form among some of a map's fragments.

    Only placed fragments count, and only components of two or more; the largest comes first, and
    of equal ones that whose first fragment stands first in `fragments`.
    """
    poses = pose_graph.poses()
    members = [fragment for fragment in fragments if fragment in poses]
    numbers = {fragment: number for number, fragment in enumerate(members)}
    links = np.array(
        [
            (numbers[edge.pair.source], numbers[edge.pair.target])
            for edge in pose_graph.edges
            if edge.status is EdgeStatus.ACCEPTED
            and edge.pair.source in numbers
            and edge.pair.target in numbers
        ]
    ).reshape(-1, 2)
    shape = (len(members), len(members))
    adjacency = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=shape)
    count, labels = connected_components(adjacency, directed=False) if members else (0, [])
    components: list[list[FragmentId]] = [[] for _ in range(count)]
    for fragment, label in zip(members, labels, strict=True):
        components[label].append(fragment)
    return sorted((c for c in components if len(c) > 1), key=len, reverse=True)


def _template(
    name: str,
    nodes: list[tuple[int | str, str]],
    edges: list[tuple[int | str, int | str, bool | None]] | None,
) -> ChallengeGraph:
    return ChallengeGraph(
        name,
        tuple(ChallengeNode(node_id, node_name) for node_id, node_name in nodes),
        None if edges is None else tuple(ChallengeEdge(s, t, same_stage=f) for s, t, f in edges),
    )


def _numbered(name: str, ids: Sequence[FragmentId]) -> ChallengeGraph:
    return ChallengeGraph(name, tuple(ChallengeNode(i, f"{id_}.ply") for i, id_ in enumerate(ids)))


def _template_edges(
    template: ChallengeGraph, ids: dict[int | str, FragmentId], complete: bool
) -> list[ChallengeEdge] | None:
    edges = list(template.edges or ())
    if not edges and complete:
        return None
    if not edges:
        edges = [ChallengeEdge(source, target) for source, target in permutations(ids, 2)]
    return [
        ChallengeEdge(
            edge.source,
            edge.target,
            same_stage=_same_stage(ids[edge.source], ids[edge.target])
            if edge.same_stage is None
            else edge.same_stage,
        )
        for edge in edges
    ]


def _same_stage(source: FragmentId, target: FragmentId) -> bool:
    return (source.area, source.stage) == (target.area, target.stage)
