"""Publishes the clouds of a map: seldom while it changes, always when it is settled."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2

from nss_ros import topics
from nss_ros.config import PoseGraphConfig
from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.messages import cloud_message, rosidl_family
from nss_ros.multiway.map_clouds import MapClouds
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.nodes.qos import publisher_qos
from nss_ros.topics import Topic

_MEGABYTE = 1e6


class MapPublisher:
    """The map as clouds: a log keeps every one that is published, so only what is new is.

    Args:
        node: that publishes.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clouds = MapClouds()
        self._publishers: dict[Topic, Publisher] = {}
        self._frame = ""
        self._due = 0.0
        self._publisher(topics.MAP)

    def publish(
        self,
        fragments: Mapping[FragmentId, Fragment],
        graph: PoseGraph,
        config: PoseGraphConfig,
        settled: bool,
    ) -> None:
        """Publish the clouds that changed, if it is time for them.

        Args:
            fragments: by id.
            graph: poses.
            config: voxel size, frame, and how much clouds may take.
            settled: nothing more is to be expected: every change counts, and now.
        """
        if not settled and time.monotonic() < self._due:
            return
        voxel_size = config.map_voxel_size
        tolerance = 0.0 if settled else voxel_size
        changed = self._clouds.update(fragments, graph, voxel_size, tolerance)
        if config.map_frame != self._frame:
            changed |= self._clouds.layers()
        self._frame = config.map_frame
        stages = sorted(stage for component, stage in changed if component == 0)
        if not stages:
            return
        size = self._send(topics.MAP, *self._clouds.component(0))
        for stage in stages:
            size += self._send(topics.stage_map(stage), *self._clouds.stage(0, stage))
        self._due = time.monotonic() + size / (config.map_rate * _MEGABYTE)

    def _send(self, topic: Topic, points: Points, stages: NDArray[np.float32]) -> int:
        """Publish one cloud; its size in bytes."""
        columns = dict(zip("xyz", points.T, strict=True)) | {"stage": stages}
        stamp = int(self._node.get_clock().now().nanoseconds)
        message = cloud_message(columns, self._frame, stamp, rosidl_family())
        self._publisher(topic).publish(message)
        return len(message.data)

    def _publisher(self, topic: Topic) -> Publisher:
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(
                PointCloud2, topic.name, publisher_qos(topic)
            )
        return self._publishers[topic]
