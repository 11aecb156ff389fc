"""Taking messages in: what is not valid is reported and ignored, never fatal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.node import Node

from nss_ros.errors import InputError

T = TypeVar("T")


def converted(node: Node, convert: Callable[[Any], T], message: Any) -> T | None:
    """The message as a core type; None, with an error in the node's log, if it is not valid."""
    try:
        return convert(message)
    except InputError as error:
        node.get_logger().error(f"{type(message).__name__} ignored: {error}")
        return None
