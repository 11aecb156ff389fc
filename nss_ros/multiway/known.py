"""What a solution with points found, kept in force while further answers come in.

Without points little is known of new answers, but what was decided with points need not be decided
again: its poses are parts of the map that new fragments are joined to, of each pair that it
accepted its hypothesis stays, what it rejected stays rejected, and what it found by submaps stays.
A person has the last word: what a constraint contradicts, or was made by a constraint that is
gone, is forgotten, and an answer that was excluded takes along what hangs on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nss_ros.fragment import FragmentId
from nss_ros.geometry import relative
from nss_ros.multiway.closures import SUBMAP_CONFIDENCE
from nss_ros.multiway.hypotheses import fitting_hypothesis
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus, Measurement, PoseGraph
from nss_ros.multiway.spanning_tree import Closeness, Poses, components


@dataclass(frozen=True, slots=True)
class Known:
    """A problem, as far as it was solved before.

    Attributes:
        parts: poses of fragments that are linked, each part in a frame of its own.
        measurements: those to solve: new ones, and known ones by the hypothesis that was right.
        rejected: those that were rejected, and why.
    """

    parts: tuple[Poses, ...]
    measurements: tuple[Measurement, ...]
    rejected: tuple[tuple[Measurement, str], ...]


def known_by(graph: PoseGraph, measurements: Sequence[Measurement], close: Closeness) -> Known:
    """What a solution says of measurements that may have changed since.

    Args:
        graph: the solution, of fragments that are all still there.
        measurements: all of now, with their alternatives.
        close: when a constraint agrees with the poses.
    """
    component = {id_: node.component for id_, node in graph.poses().items()}
    forgotten = _contradicted(graph, measurements, close)
    edges = [
        edge
        for edge in graph.edges
        if not {component.get(end) for end in _ends(edge)} & forgotten
        and edge.status is not EdgeStatus.FAILED
    ]
    ids = sorted(id_ for id_, number in component.items() if number not in forgotten)
    linking = _still_linking(ids, edges, measurements)
    parts = components(ids, linking)
    part = {id_: number for number, members in enumerate(parts) for id_ in members}

    def split(edge: Edge) -> bool:
        source, target = _ends(edge)
        there = component.get(source), component.get(target)
        return None not in there and there[0] == there[1] and part[source] != part[target]

    decided = {edge.pair: edge for edge in edges if _answer(edge) and not split(edge)}
    taken: list[Measurement] = []
    rejected: list[tuple[Measurement, str]] = []
    for m in measurements:
        edge = None if m.manual else decided.get(m.pair)
        if edge is None:
            taken.append(m)
        elif edge.status is EdgeStatus.ACCEPTED:
            taken.append(_chosen(m, edge, close))
        else:
            rejected.append((m, edge.reason))
    found = [_of_submaps(edge) for edge in linking if _found(edge)]
    poses = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
    return Known(
        tuple({id_: poses[id_] for id_ in members} for members in parts if len(members) > 1),
        (*taken, *found),
        tuple(rejected),
    )


def _contradicted(
    graph: PoseGraph, measurements: Sequence[Measurement], close: Closeness
) -> set[int | None]:
    """Components whose poses are not what the constraints of now say."""
    placed = graph.poses()
    constraints = {m.pair: m.T_target_source for m in measurements if m.manual}
    wrong: set[int | None] = set()
    for edge in graph.edges:
        if edge.kind is EdgeKind.MANUAL:
            now = constraints.get(edge.pair)
            if now is None or not np.array_equal(now, edge.T_target_source):
                wrong |= {placed[end].component for end in _ends(edge) if end in placed}
    for pair, T_target_source in constraints.items():
        source, target = placed.get(pair.source), placed.get(pair.target)
        if source is None or target is None or source.component != target.component:
            continue
        there = relative(source.T_map_fragment, target.T_map_fragment)
        if not close.agree(T_target_source, there[None])[0]:
            wrong.add(source.component)
    return wrong


def _still_linking(
    ids: list[FragmentId], edges: Sequence[Edge], measurements: Sequence[Measurement]
) -> list[Edge]:
    """The accepted edges that still are there.

    What was found by submaps goes where it only followed from answers that are gone.
    """
    given = {(m.pair, m.manual) for m in measurements}
    accepted = [edge for edge in edges if edge.status is EdgeStatus.ACCEPTED]
    answers = [edge for edge in accepted if not _found(edge)]
    left = [edge for edge in answers if (edge.pair, edge.kind is EdgeKind.MANUAL) in given]
    before, after = _numbers(ids, answers), _numbers(ids, left)

    def holds(edge: Edge) -> bool:
        source, target = _ends(edge)
        return before[source] != before[target] or after[source] == after[target]

    return left + [edge for edge in accepted if _found(edge) and holds(edge)]


def _numbers(ids: list[FragmentId], edges: Iterable[Edge]) -> dict[FragmentId, int]:
    groups = components(ids, list(edges))
    return {id_: number for number, members in enumerate(groups) for id_ in members}


def _ends(edge: Edge) -> tuple[FragmentId, FragmentId]:
    return edge.pair.source, edge.pair.target


def _answer(edge: Edge) -> bool:
    return edge.kind not in (EdgeKind.MANUAL, EdgeKind.SUBMAP)


def _found(edge: Edge) -> bool:
    return edge.kind is EdgeKind.SUBMAP


def _chosen(m: Measurement, edge: Edge, close: Closeness) -> Measurement:
    """The measurement by the hypothesis that became the edge, as sure as submaps are."""
    chosen = fitting_hypothesis(m, edge.T_target_source, close)
    if chosen is None:
        return m
    return replace(chosen, confidence=max(chosen.confidence, SUBMAP_CONFIDENCE))


def _of_submaps(edge: Edge) -> Measurement:
    return Measurement(
        edge.pair,
        edge.T_target_source,
        np.asarray(np.linalg.inv(edge.covariance)),
        confidence=SUBMAP_CONFIDENCE,
        inliers=edge.inliers,
        level=True,
        submap=True,
    )
