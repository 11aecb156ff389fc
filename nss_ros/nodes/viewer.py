"""A running graph in a scene. Listens only; it may come late and leave at any time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from nss_msgs.msg import Fragment as FragmentMessage
from nss_msgs.msg import PoseGraph as PoseGraphMessage
from nss_msgs.msg import RelativeTransform as RelativeTransformMessage
from nss_ros import topics
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.messages import fragment_from, pose_graph_from, relative_transform_from
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.nodes.intake import converted
from nss_ros.nodes.qos import latest_qos, subscription_qos
from nss_ros.registration.relative_transform import RelativeTransform
from nss_ros.viewing.scene import Scene

_SPIN = 0.2


class LiveView:
    """Subscribes to a graph, in a ROS context of its own, and draws what comes.

    Args:
        scene: where it is drawn.
        namespace: of the graph.
    """

    def __init__(self, scene: Scene, namespace: str = "") -> None:
        self._scene = scene
        self._fragments: dict[FragmentId, Fragment] = {}
        self._answers: dict[FragmentPair, RelativeTransform] = {}
        self._new: list[RelativeTransform] = []
        self._graph: PoseGraph | None = None
        self._changed = False
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node(
            "viewer", namespace=namespace, context=self._context, start_parameter_services=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        subscribe: Any = self._node.create_subscription
        for message_type, topic, callback, qos in (
            (FragmentMessage, topics.FRAGMENTS, self._on_fragment, subscription_qos),
            (
                RelativeTransformMessage,
                topics.RELATIVE_TRANSFORMS,
                self._on_answer,
                subscription_qos,
            ),
            (PoseGraphMessage, topics.POSE_GRAPH, self._on_graph, latest_qos),
        ):
            subscribe(message_type, topic.name, callback, qos(topic))

    @property
    def counts(self) -> tuple[int, int, int]:
        """Fragments and answers received, and fragments placed in the last graph."""
        placed = len(self._graph.poses()) if self._graph else 0
        return len(self._fragments), len(self._answers), placed

    def spin(self, seconds: float) -> None:
        """Listen for a while, then draw what is new."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        if self._new:
            self._scene.add_answers(self._new)
            self._new = []
        if self._graph is not None and self._changed:
            self._changed = False
            self._scene.draw_graph(self._graph, self._answers)
            self._scene.draw_map(self._graph, self._fragments)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_fragment(self, message: FragmentMessage) -> None:
        fragment = converted(self._node, fragment_from, message)
        if fragment is not None and fragment.id not in self._fragments:
            self._fragments[fragment.id] = fragment
            self._changed = True

    def _on_answer(self, message: RelativeTransformMessage) -> None:
        answer = converted(self._node, relative_transform_from, message)
        if answer is not None and answer.pair not in self._answers:
            self._answers[answer.pair] = answer
            self._new.append(answer)

    def _on_graph(self, message: PoseGraphMessage) -> None:
        graph = converted(self._node, pose_graph_from, message)
        if graph is not None:
            self._graph, self._changed = graph, True


def view_live(
    scene: Scene,
    namespace: str = "",
    duration: float = 0.0,
    report: Callable[[int, int, int], None] = lambda *_: None,
) -> None:
    """Draw a running graph until interrupted.

    Args:
        scene: where it is drawn.
        namespace: of the graph.
        duration: seconds after which to end; 0: at the interrupt.
        report: called several times a second with the view's counts.
    """
    view = LiveView(scene, namespace)
    end = time.monotonic() + duration
    try:
        while duration == 0 or time.monotonic() < end:
            view.spin(_SPIN)
            report(*view.counts)
    finally:
        view.close()
