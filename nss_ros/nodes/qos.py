"""Quality of service of the topics, as rclpy wants it."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from nss_ros.topics import Topic


def publisher_qos(topic: Topic, depth: int | None = None) -> QoSProfile:
    """Reliable; keeps `depth` messages (default the topic's own) for late joiners if latched."""
    return _profile(topic, topic.depth if depth is None else depth)


def subscription_qos(topic: Topic) -> QoSProfile:
    """Reliable and lossless: a reader that keeps all makes the writer wait, not overwrite."""
    return _profile(topic, 0)


def latest_qos(topic: Topic) -> QoSProfile:
    """Reliable, for a reader that wants the newest message only."""
    return _profile(topic, 1)


def _profile(topic: Topic, depth: int) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST if depth else HistoryPolicy.KEEP_ALL,
        depth=depth,
    )
