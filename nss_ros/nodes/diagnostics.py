"""Health of a node on /diagnostics, once a second."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from nss_ros.nodes.qos import publisher_qos
from nss_ros.topics import DIAGNOSTICS

Health = tuple[bool, str, Mapping[str, object]]


def publish_diagnostics(node: Node, health: Callable[[], Health]) -> None:
    """Publish what `health` says: whether all is well, a sentence, and values to show."""
    publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS.name, publisher_qos(DIAGNOSTICS))

    def publish() -> None:
        well, sentence, values = health()
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK if well else DiagnosticStatus.WARN,
            name=node.get_fully_qualified_name(),
            message=sentence,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(array)

    node.create_timer(1.0, publish)
