"""Publishes what is to be seen of a map: clouds and markers of each component in its frame."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from nss_ros import topics
from nss_ros.config import PoseGraphConfig
from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.messages import cloud_message, rosidl_family
from nss_ros.multiway.map_clouds import MapClouds
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.nodes.markers import graph_markers
from nss_ros.nodes.qos import publisher_qos
from nss_ros.topics import Topic

_MEGABYTE = 1e6


class MapPublisher:
    """The map for viewers. A log keeps every cloud, so they come seldom while the map changes.

    Args:
        node: that publishes.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clouds = MapClouds()
        self._publishers: dict[Topic, Publisher] = {}
        self._frame = ""
        self._due = 0.0
        for topic in (topics.MAP, topics.MARKERS):
            self._publisher(topic)

    def publish_markers(self, graph: PoseGraph, config: PoseGraphConfig) -> None:
        """Publish the markers of all components, and clear those of components that are gone."""
        components = {0} | {node.component for node in graph.poses().values()}
        for number in range(topics.MOST_COMPONENTS):
            topic = topics.component_markers(number)
            if number in components or topic in self._publishers:
                frame = topics.component_frame(config.map_frame, number)
                self._publisher(topic).publish(graph_markers(graph, frame, number))

    def publish_clouds(
        self,
        fragments: Mapping[FragmentId, Fragment],
        graph: PoseGraph,
        config: PoseGraphConfig,
        final: bool,
    ) -> bool:
        """Publish the clouds that changed, if it is time for them; False if it is not.

        Args:
            fragments: by id.
            graph: poses.
            config: voxel size, frame, and how much clouds may take.
            final: nothing more is to be expected: every change counts, and now.
        """
        if not final and time.monotonic() < self._due:
            return False
        voxel_size = config.map_voxel_size
        tolerance = 0.0 if final else voxel_size
        changed = self._clouds.update(fragments, graph, voxel_size, tolerance)
        if config.map_frame != self._frame:
            changed |= self._clouds.layers()
        self._frame = config.map_frame
        size = 0
        for component in sorted({component for component, _ in changed}):
            if component < topics.MOST_COMPONENTS:
                cloud = self._clouds.component(component)
                size += self._send(topics.component_map(component), *cloud, component)
        for stage in sorted(stage for component, stage in changed if component == 0):
            size += self._send(topics.stage_map(stage), *self._clouds.stage(0, stage))
        if changed:
            self._due = time.monotonic() + size / (config.map_rate * _MEGABYTE)
        return True

    def _send(
        self, topic: Topic, points: Points, stages: NDArray[np.float32], component: int = 0
    ) -> int:
        """Publish one cloud; its size in bytes."""
        columns = dict(zip("xyz", points.T, strict=True)) | {"stage": stages}
        stamp = int(self._node.get_clock().now().nanoseconds)
        frame = topics.component_frame(self._frame, component)
        message = cloud_message(columns, frame, stamp, rosidl_family())
        self._publisher(topic).publish(message)
        return len(message.data)

    def _publisher(self, topic: Topic) -> Publisher:
        if topic not in self._publishers:
            kind = MarkerArray if topic.type == topics.MARKERS.type else PointCloud2
            self._publishers[topic] = self._node.create_publisher(
                kind, topic.name, publisher_qos(topic)
            )
        return self._publishers[topic]
