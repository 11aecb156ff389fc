"""Pose graphs: what a multi-way method takes and gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Matrix, Transform

# Ids that a sentence tells.
_MOST_TOLD = 12


class EdgeKind(IntEnum):
    """What an edge links; the values of nss_msgs/PoseGraphEdge KIND_*."""

    SAME_STAGE = 0
    DIFFERENT_STAGE = 1
    MANUAL = 2
    SUBMAP = 3


class EdgeStatus(IntEnum):
    """What became of an edge; the values of nss_msgs/PoseGraphEdge STATUS_*."""

    ACCEPTED = 0
    REJECTED = 1
    FAILED = 2


class NodeStatus(IntEnum):
    """What became of a fragment; the values of nss_msgs/FragmentPose STATUS_*.

    That of the message for a doubtful place is `PLACED` here: see `Node.doubtful`.
    """

    UNPLACED = 0
    PLACED = 1
    OUTLIER = 2


@dataclass(frozen=True, slots=True)
class Alternative:
    """A less probable relative transform of an ambiguous pair.

    Attributes:
        T_target_source: (4, 4).
        information: (6, 6), as that of a measurement.
        probability: 0..1, of being right.
    """

    T_target_source: Transform
    information: Matrix
    probability: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """A relative transform as input of a multi-way method.

    Attributes:
        pair: source and target.
        T_target_source: (4, 4).
        information: (6, 6) inverse covariance, order x y z rx ry rz (m, rad), target frame.
        confidence: 0..1, how likely it is to be right.
        inliers: points that support it.
        level: both fragments are gravity aligned, so a right transform does not tilt.
        manual: given by a person; never rejected.
        submap: found by registering submaps, not an answer to a pair.
        alternatives: further hypotheses, the most probable first.
    """

    pair: FragmentPair
    T_target_source: Transform
    information: Matrix = field(default_factory=lambda: np.eye(6))
    confidence: float = 1.0
    inliers: int = 0
    level: bool = False
    manual: bool = False
    submap: bool = False
    alternatives: tuple[Alternative, ...] = ()

    @property
    def kind(self) -> EdgeKind:
        """Same stage, different stage, manual or submap."""
        if self.manual:
            return EdgeKind.MANUAL
        if self.submap:
            return EdgeKind.SUBMAP
        return EdgeKind.SAME_STAGE if self.pair.same_stage else EdgeKind.DIFFERENT_STAGE


@dataclass(frozen=True, slots=True)
class Node:
    """A fragment in the map.

    Attributes:
        id: the fragment.
        T_map_fragment: (4, 4) pose in the map frame of its component; the identity, meaning
            nothing, unless `status` is PLACED.
        status: placed or not.
        component: connected component, 0 is the largest.
        covariance: (6, 6) of the pose relative to the component's anchor; zero when not computed.
        doubtful: placed by so little that was seen that the place may be a wrong one.
    """

    id: FragmentId
    T_map_fragment: Transform = field(default_factory=lambda: np.eye(4))
    status: NodeStatus = NodeStatus.UNPLACED
    component: int = 0
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    doubtful: bool = False


@dataclass(frozen=True, slots=True)
class Edge:
    """A relative transform in the map.

    Attributes:
        pair: source and target.
        T_target_source: (4, 4) as measured (ground truth: as given).
        covariance: (6, 6) as measured, order x y z rx ry rz (m, rad), target frame; zero when
            not known.
        kind: same stage, different stage, manual or submap.
        status: accepted, rejected or failed.
        reason: for people, why it was rejected or failed.
        residual_translation: metres between measured and optimised; NaN when not placed.
        residual_rotation: radians between measured and optimised; NaN when not placed.
        weight: weight in the final optimisation, 0..1.
        overlap_ratio: NaN when unknown.
        temporal_change: NaN when unknown.
        inliers: points that support it; 0 when unknown.
    """

    pair: FragmentPair
    T_target_source: Transform
    kind: EdgeKind
    status: EdgeStatus = EdgeStatus.ACCEPTED
    reason: str = ""
    residual_translation: float = float("nan")
    residual_rotation: float = float("nan")
    weight: float = 1.0
    overlap_ratio: float = float("nan")
    temporal_change: float = float("nan")
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    inliers: int = 0


@dataclass(frozen=True, slots=True)
class PoseGraph:
    """Fragments with poses and the relative transforms between them.

    Attributes:
        nodes: one per fragment, in canonical order (ground truth: in the dataset's order).
        edges: one per measurement.
        name: map name, or the graph's name in the dataset.
        synchronizer: registered name of the method that made it.
    """

    nodes: tuple[Node, ...] = ()
    edges: tuple[Edge, ...] = ()
    name: str = ""
    synchronizer: str = ""

    def poses(self) -> dict[FragmentId, Node]:
        """The placed nodes by fragment id."""
        return {node.id: node for node in self.nodes if node.status is NodeStatus.PLACED}

    def doubtful(self) -> list[FragmentId]:
        """The placed fragments whose place is doubtful, in the order of the nodes."""
        return [id_ for id_, node in self.poses().items() if node.doubtful]

    def rms_residual(self) -> float:
        """Root mean square of the accepted edges' translation residuals, metres; NaN without."""
        residuals = [
            edge.residual_translation
            for edge in self.edges
            if edge.status is EdgeStatus.ACCEPTED and np.isfinite(edge.residual_translation)
        ]
        return float(np.sqrt(np.mean(np.square(residuals)))) if residuals else float("nan")


def doubtful_sentence(ids: Sequence[FragmentId] | Sequence[str]) -> str:
    """What people are told of fragments whose place is doubtful; `ids` are one or more."""
    shown = ", ".join(map(str, ids[:_MOST_TOLD]))
    more = f" and {len(ids) - _MOST_TOLD} more" if len(ids) > _MOST_TOLD else ""
    return f"Placed by little that was seen, so perhaps wrongly: {shown}{more}."
