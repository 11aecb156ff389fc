"""Measurements and what becomes of them, and the pose graph that they make in the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, inverse, relative, rotation_angle, tilt_angle
from nss_ros.multiway.covariance import pose_covariances
from nss_ros.multiway.pose_graph import (
    Edge,
    EdgeStatus,
    Measurement,
    Node,
    NodeStatus,
    PoseGraph,
)
from nss_ros.multiway.spanning_tree import Closeness, Poses, anchored, components


@dataclass(slots=True)
class JudgedEdge:
    """A measurement and what became of it."""

    measurement: Measurement
    accepted: bool = True
    reason: str = ""
    support: int = 0
    weight: float = 1.0

    def reject(self, reason: str) -> None:
        """The measurement is wrong; `reason` is for people."""
        self.accepted, self.reason, self.weight = False, reason, 0.0


def judged_edges(
    ids: Sequence[FragmentId], measurements: Sequence[Measurement], config: MultiwayConfig
) -> list[JudgedEdge]:
    """The measurements in canonical order, those rejected that cannot be right by themselves."""
    known = set(ids)
    limit = np.deg2rad(config.max_tilt)
    edges = [JudgedEdge(m) for m in sorted(measurements, key=canonical)]
    for edge in edges:
        m = edge.measurement
        if m.pair.source not in known or m.pair.target not in known:
            edge.reject("unknown fragment")
        elif m.manual:
            continue
        elif m.confidence < config.min_confidence:
            edge.reject(f"confidence {m.confidence:.2f} is below min_confidence")
        elif m.level and (tilt := tilt_angle(m.T_target_source)) > limit:
            edge.reject(f"tilts levelled fragments by {np.rad2deg(tilt):.1f} deg")
    return edges


def canonical(m: Measurement) -> tuple[object, ...]:
    """By which measurements are sorted, so that their order on arrival does not matter."""
    return (m.pair, m.manual, m.T_target_source.tobytes())


def relative_of(m: Measurement, poses: Poses) -> Transform:
    """`T_target_source` of a measurement's pair by poses."""
    return relative(poses[m.pair.source], poses[m.pair.target])


def residual(m: Measurement, poses: Poses) -> tuple[float, float]:
    """Distance (m) and angle (rad) between measured and optimised `T_target_source`."""
    error = inverse(m.T_target_source) @ relative_of(m, poses)
    return float(np.linalg.norm(error[:3, 3])), rotation_angle(error)


def contradiction(m: Measurement, poses: Poses, close: Closeness) -> str:
    """What people are told of a measurement that poses contradict; empty if they do not."""
    translation, rotation = residual(m, poses)
    if translation <= close.translation and rotation <= close.rotation:
        return ""
    return f"contradicts the others by {translation:.2f} m, {np.rad2deg(rotation):.1f} deg"


def judged_graph(
    ids: list[FragmentId], edges: Sequence[JudgedEdge], poses: Poses, name: str
) -> PoseGraph:
    """The pose graph of poses: a component is what accepted edges link, in a frame of its own.

    Args:
        ids: all fragments, in canonical order.
        edges: with what became of them, in the order that they are to have.
        poses: `T_map_fragment` of all fragments; those that accepted edges link have one map frame.
        name: of the synchronizer.
    """
    accepted = [edge.measurement for edge in edges if edge.accepted]
    nodes: list[Node] = []
    component: dict[FragmentId, int] = {}
    for number, members in enumerate(components(ids, accepted)):
        component |= dict.fromkeys(members, number)
        if len(members) == 1:
            nodes.append(Node(members[0]))
            continue
        own = anchored({id_: poses[id_] for id_ in members}, members[0])
        inside = [m for m in accepted if component.get(m.pair.source) == number]
        covariances = pose_covariances(members, inside, own)
        nodes += [
            Node(id_, own[id_], NodeStatus.PLACED, number, covariances[id_]) for id_ in members
        ]
    nodes.sort(key=lambda node: node.id)
    placed = {node.id for node in nodes if node.status is NodeStatus.PLACED}
    return PoseGraph(
        tuple(nodes),
        tuple(_edge(edge, component, placed, poses) for edge in edges),
        synchronizer=name,
    )


def _edge(
    edge: JudgedEdge, component: dict[FragmentId, int], placed: set[FragmentId], poses: Poses
) -> Edge:
    m = edge.measurement
    ends = (m.pair.source, m.pair.target)
    together = all(id_ in placed for id_ in ends) and component[ends[0]] == component[ends[1]]
    translation, rotation = residual(m, poses) if together else (float("nan"), float("nan"))
    return Edge(
        m.pair,
        m.T_target_source,
        m.kind,
        EdgeStatus.ACCEPTED if edge.accepted else EdgeStatus.REJECTED,
        edge.reason,
        residual_translation=translation,
        residual_rotation=rotation,
        weight=edge.weight,
        covariance=np.asarray(np.linalg.inv(m.information)),
        inliers=m.inliers,
    )
