"""Watching a running graph: how far it is, and whether it is done."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from nss_msgs.msg import FragmentPose, PlaybackStatus
from nss_msgs.msg import PoseGraph as PoseGraphMessage
from nss_msgs.msg import RelativeTransform as RelativeTransformMessage
from nss_ros import topics
from nss_ros.nodes.qos import latest_qos, subscription_qos


@dataclass(slots=True)
class Progress:
    """State of a run.

    Attributes:
        playing: the player was heard of.
        played: the player has published everything.
        fragments: published so far.
        fragments_total: in the bags.
        pairs_answered: relative transforms seen, failures included.
        pairs_failed: of these, failures.
        pairs_total: in the bags and proposed by the registration node.
        nodes: fragments that the pose graph knows.
        placed: of these, placed in the largest component.
        components: of the placed fragments.
        doubtful: ids of placed fragments whose place is doubtful.
        rms_residual: metres; NaN without accepted edges.
        settled: the pose graph includes everything it received.
        decided: every registration node has received all fragments and will propose no more pairs.
        warnings: of the nodes, when they have ended.
    """

    playing: bool = False
    played: bool = False
    fragments: int = 0
    fragments_total: int = 0
    pairs_answered: int = 0
    pairs_failed: int = 0
    pairs_total: int = 0
    nodes: int = 0
    placed: int = 0
    components: int = 0
    doubtful: list[str] = field(default_factory=list)
    rms_residual: float = math.nan
    settled: bool = False
    graph_answered: int = 0
    decided: bool = False
    warnings: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Everything was played, every pair is answered, and the graph includes it all."""
        return (
            self.played
            and self.settled
            and self.nodes >= self.fragments_total
            and self.decided
            and self.graph_answered >= self.pairs_total
        )


class Monitor:
    """Subscribes to the graph's state, in a ROS context of its own.

    Args:
        namespace: of the graph.
        registration_nodes: that share the pairs. A node that was not heard yet may still propose
            some.
    """

    def __init__(self, namespace: str, registration_nodes: int = 1) -> None:
        self.progress = Progress()
        self._registration_nodes = registration_nodes
        self._answered: set[tuple[str, str]] = set()
        self._pairs_in_bags = 0
        # What each registration node says of itself.
        self._registration: dict[str, dict[str, int]] = {}
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node(
            "monitor", namespace=namespace, context=self._context, start_parameter_services=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        for message_type, topic, callback, qos in (
            (PlaybackStatus, topics.PLAYBACK_STATUS, self._on_status, latest_qos),
            (
                RelativeTransformMessage,
                topics.RELATIVE_TRANSFORMS,
                self._on_answer,
                subscription_qos,
            ),
            (PoseGraphMessage, topics.POSE_GRAPH, self._on_pose_graph, latest_qos),
            (DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, subscription_qos),
        ):
            self._node.create_subscription(message_type, topic.name, callback, qos(topic))

    def spin(self, seconds: float) -> Progress:
        """Listen for a while; the state after it."""
        deadline = self._node.get_clock().now().nanoseconds + round(seconds * 1e9)
        while (left := deadline - self._node.get_clock().now().nanoseconds) > 0:
            self._executor.spin_once(timeout_sec=left / 1e9)
        return self.progress

    def foreign_publishers(self) -> list[str]:
        """Nodes that already publish fragments or pose graphs under this namespace."""
        return sorted(
            {
                f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                for topic in (topics.PLAYBACK_STATUS, topics.POSE_GRAPH)
                for info in self._node.get_publishers_info_by_topic(
                    self._node.resolve_topic_name(topic.name)
                )
            }
        )

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_status(self, message: PlaybackStatus) -> None:
        self.progress.playing = True
        self.progress.played = message.state == PlaybackStatus.STATE_FINISHED
        self.progress.fragments = message.fragments_published
        self.progress.fragments_total = message.fragments_total
        self._pairs_in_bags = message.pairs_total
        self._count_pairs()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        namespace = self._node.get_namespace()
        for status in message.status:
            values = {each.key: each.value for each in status.values}
            if status.name.rpartition("/")[0] == namespace.rstrip("/") and "undecided" in values:
                names = ("fragments", "proposed", "undecided")
                self._registration[status.name] = {name: int(values[name]) for name in names}
        self._count_pairs()

    def _count_pairs(self) -> None:
        nodes = self._registration.values()
        self.progress.pairs_total = self._pairs_in_bags + sum(node["proposed"] for node in nodes)
        self.progress.decided = len(nodes) >= self._registration_nodes and all(
            node["fragments"] >= self.progress.fragments_total and node["undecided"] == 0
            for node in nodes
        )

    def _on_answer(self, message: RelativeTransformMessage) -> None:
        pair = (message.source_id, message.target_id)
        if pair not in self._answered:
            self._answered.add(pair)
            failed = message.status != RelativeTransformMessage.STATUS_OK
            self.progress.pairs_failed += failed
            self.progress.pairs_answered = len(self._answered)

    def _on_pose_graph(self, message: PoseGraphMessage) -> None:
        doubtful = FragmentPose.STATUS_DOUBTFUL
        statuses = (FragmentPose.STATUS_PLACED, doubtful)
        placed = [node for node in message.nodes if node.status in statuses]
        self.progress.nodes = len(message.nodes)
        self.progress.placed = sum(node.component == 0 for node in placed)
        self.progress.doubtful = [node.id for node in placed if node.status == doubtful]
        self.progress.components = len({node.component for node in placed})
        self.progress.rms_residual = message.rms_residual
        self.progress.settled = message.settled
        self.progress.graph_answered = message.pairs_answered
