"""Maps of the areas of a dataset from the answers to its pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from nss_ros.batch.source import open_source
from nss_ros.config import MultiwayConfig, RegistrationConfig
from nss_ros.fragment import FragmentId
from nss_ros.multiway.multi_stage_map import MultiStageMap
from nss_ros.multiway.pose_graph import NodeStatus, PoseGraph
from nss_ros.multiway.solver import Problem, prepared_by, solve
from nss_ros.registration.relative_transform import RelativeTransform


@dataclass(frozen=True, slots=True)
class AreaTask:
    """What a synchronizer is given of an area.

    Attributes:
        config: which synchronizer, and its settings.
        source: dataset or bag that holds the points of the fragments.
        fragments: of the area, or of all that is one map.
        results: answers to its pairs, failures too.
    """

    config: MultiwayConfig
    source: Path
    fragments: tuple[FragmentId, ...]
    results: tuple[RelativeTransform, ...]


def area_map(task: AreaTask) -> PoseGraph | str:
    """The map of an area, as the pose-graph node makes it; or for people, why there is none."""
    map_ = MultiStageMap(RegistrationConfig().voxel_size)
    source = open_source(task.source)
    for id_ in task.fragments:
        map_.add_fragment(source.fragment(id_))
    for result in task.results:
        map_.add_pair(result.pair)
        map_.add_result(result)
    ids = sorted(map_.fragments)
    problem = Problem(task.config, ids, map_.measurements(), map_.unused_edges())
    try:
        return solve(problem, prepared_by(task.config, (map_.fragments[id_] for id_ in ids)))
    except Exception as error:  # a plug-in may raise anything, and other maps are to be made
        return f"{type(error).__name__}: {error}"


def joined_maps(maps: Sequence[PoseGraph]) -> PoseGraph:
    """Maps of several areas as one graph, its components numbered by size as in any map."""
    numbers = _component_numbers(maps)
    nodes = (
        replace(node, component=numbers[number, node.component])
        if node.status is NodeStatus.PLACED
        else node
        for number, graph in enumerate(maps)
        for node in graph.nodes
    )
    edges = (edge for graph in maps for edge in graph.edges)
    return PoseGraph(
        tuple(sorted(nodes, key=lambda node: node.id)),
        tuple(sorted(edges, key=lambda edge: (edge.pair, edge.kind))),
        maps[0].name if maps else "",
        _only(graph.synchronizer for graph in maps),
    )


def _component_numbers(maps: Sequence[PoseGraph]) -> dict[tuple[int, int], int]:
    """The new number of each map's components: largest first, ties in canonical order."""
    members: dict[tuple[int, int], list[FragmentId]] = {}
    for number, graph in enumerate(maps):
        for id_, node in graph.poses().items():
            members.setdefault((number, node.component), []).append(id_)
    order = sorted(members, key=lambda each: (-len(members[each]), min(members[each])))
    return {each: number for number, each in enumerate(order)}


def _only(names: Iterable[str]) -> str:
    return " + ".join(dict.fromkeys(names))
