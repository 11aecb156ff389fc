"""Entry points of the nodes, which import the node itself when they are called.

Importing takes seconds, and Ctrl-C must end a node quietly in that time too.
"""

from __future__ import annotations

import os
from importlib import import_module


def fragment_player() -> None:
    """Run the node `fragment_player`."""
    _start("fragment_player")


def registration() -> None:
    """Run the node `registration`."""
    _start("registration")


def pose_graph() -> None:
    """Run the node `pose_graph`."""
    _start("pose_graph")


def recorder() -> None:
    """Run the node `recorder`."""
    _start("recorder")


def _start(node: str) -> None:
    try:
        import_module(f"nss_ros.nodes.{node}").main()
    except KeyboardInterrupt:
        # Nothing was begun. Half-imported libraries need not survive the interpreter's own end.
        os._exit(0)
