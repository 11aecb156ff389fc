"""Pose graphs in the frames of standpoints, where scanners stood, and in those of fragments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Matrix, Transform, adjoint, inverse, relative, rotation_angle
from nss_ros.multiway.pose_graph import Edge, Measurement, Node, PoseGraph
from nss_ros.standpoint import Standpoints

Places = Mapping[FragmentId, Transform]
"""Standpoints (4, 4) of those fragments that came in another frame, as poses in that."""


def between_standpoints(m: Measurement, places: Places) -> Measurement:
    """A measurement between fragments, as one between their standpoints."""
    if m.pair.source not in places and m.pair.target not in places:
        return m
    ends = _ends(m.pair, places)
    back = Standpoints(inverse(ends.source), inverse(ends.target))
    return replace(
        m,
        T_target_source=back.transform(m.T_target_source),
        information=_information(m.information, ends.target),
        alternatives=tuple(
            replace(
                each,
                T_target_source=back.transform(each.T_target_source),
                information=_information(each.information, ends.target),
            )
            for each in m.alternatives
        ),
    )


def graph_of_fragments(graph: PoseGraph, places: Places) -> PoseGraph:
    """A graph of standpoints as one of the fragments, each component in the frame of its first."""
    if not places:
        return graph
    anchors: dict[int, FragmentId] = {}
    for id_, node in graph.poses().items():
        anchors.setdefault(node.component, id_)
    nodes = tuple(
        _node(node, places, _place(anchors[node.component], places))
        if node.component in anchors and node.id in graph.poses()
        else node
        for node in graph.nodes
    )
    moved = replace(graph, nodes=nodes)
    poses = {id_: node.T_map_fragment for id_, node in moved.poses().items()}
    edges = tuple(_edge(edge, _ends(edge.pair, places), poses) for edge in graph.edges)
    return replace(moved, edges=edges)


def _node(node: Node, places: Places, T_new_old: Transform) -> Node:
    """A placed node in its own frame, and in the frame of its anchor."""
    turned = adjoint(T_new_old)
    return replace(
        node,
        T_map_fragment=T_new_old @ node.T_map_fragment @ inverse(_place(node.id, places)),
        covariance=turned @ node.covariance @ turned.T,
    )


def _edge(edge: Edge, ends: Standpoints, poses: Mapping[FragmentId, Transform]) -> Edge:
    if ends.are_origins:
        return edge
    measured = ends.transform(edge.T_target_source)
    moved = replace(edge, T_target_source=measured, covariance=ends.covariance(edge.covariance))
    if not np.isfinite(edge.residual_translation):
        return moved
    error = inverse(measured) @ relative(poses[edge.pair.source], poses[edge.pair.target])
    return replace(
        moved,
        residual_translation=float(np.linalg.norm(error[:3, 3])),
        residual_rotation=rotation_angle(error),
    )


def _information(information: Matrix, target: Transform) -> Matrix:
    """Information of a relative transform, as of one between standpoints."""
    moved = adjoint(target)
    return np.asarray(moved.T @ information @ moved)


def _ends(pair: FragmentPair, places: Places) -> Standpoints:
    return Standpoints(_place(pair.source, places), _place(pair.target, places))


def _place(id_: FragmentId, places: Places) -> Transform:
    return places.get(id_, np.eye(4))
