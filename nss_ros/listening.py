"""Whether somebody listens at an address."""

from __future__ import annotations

import re
import socket

_PATIENCE = 5.0  # seconds


def knock(address: str) -> None:
    """Find out whether somebody listens at `host:port`, with a scheme and a path or without.

    What has no port is left to those who know what it means.

    Raises:
        OSError: nobody does.
    """
    found = re.fullmatch(r"(?:[\w+.-]+://)?\[?([^/\]]+?)\]?:([0-9]+)(?:/.*)?", address)
    if found is not None:
        socket.create_connection((found[1], int(found[2])), _PATIENCE).close()
