"""The pose graph as RViz markers: fragments by stage, doubtful ones, and edges by status."""

from __future__ import annotations

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from nss_ros.colors import ACCEPTED, REJECTED, stage_color
from nss_ros.multiway.pose_graph import EdgeStatus, Node, NodeStatus, PoseGraph

_ACCEPTED = ColorRGBA(**dict(zip("rgb", ACCEPTED, strict=True)), a=0.8)
_REJECTED = ColorRGBA(**dict(zip("rgb", REJECTED, strict=True)), a=0.4)
_DOUBTFUL = ColorRGBA(**dict(zip("rgb", REJECTED, strict=True)), a=0.5)
_NODE_SIZE = 0.25
_LINE_WIDTH = 0.03


def graph_markers(graph: PoseGraph, frame_id: str, component: int = 0) -> MarkerArray:
    """Markers of one component, the largest by default, in its frame, metres."""
    placed = {
        node.id: node
        for node in graph.nodes
        if node.status is NodeStatus.PLACED and node.component == component
    }
    clear = Marker(action=Marker.DELETEALL)
    clear.header.frame_id = frame_id
    stages = sorted({id_.stage for id_ in placed})
    markers = [clear]
    for stage in stages:
        nodes = [node for id_, node in placed.items() if id_.stage == stage]
        marker = _marker(frame_id, f"stage_{stage}", Marker.SPHERE_LIST, _NODE_SIZE)
        red, green, blue = stage_color(stage)
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
        marker.points = [_position(node) for node in nodes]
        markers.append(marker)
    doubtful = [node for node in placed.values() if node.doubtful]
    if doubtful:
        marker = _marker(frame_id, "doubtful", Marker.SPHERE_LIST, 2 * _NODE_SIZE)
        marker.color = _DOUBTFUL
        marker.points = [_position(node) for node in doubtful]
        markers.append(marker)
    for name, status, color in (
        ("accepted_edges", EdgeStatus.ACCEPTED, _ACCEPTED),
        ("rejected_edges", EdgeStatus.REJECTED, _REJECTED),
    ):
        marker = _marker(frame_id, name, Marker.LINE_LIST, _LINE_WIDTH)
        marker.color = color
        marker.points = [
            _position(placed[id_])
            for edge in graph.edges
            if edge.status is status and edge.pair.source in placed and edge.pair.target in placed
            for id_ in (edge.pair.source, edge.pair.target)
        ]
        markers.append(marker)
    return MarkerArray(markers=markers)


def _marker(frame_id: str, namespace: str, kind: int, size: float) -> Marker:
    marker = Marker(ns=namespace, type=kind, action=Marker.ADD)
    marker.header.frame_id = frame_id
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = size
    return marker


def _position(node: Node) -> Point:
    x, y, z = (float(value) for value in node.T_map_fragment[:3, 3])
    return Point(x=x, y=y, z=z)
