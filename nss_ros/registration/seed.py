"""Stable seeds and shares of fragment pairs.

Python's own `hash` of a string differs from process to process; these do not differ from process,
machine or version to another, so a pair has one answer whoever computes it.
"""

from __future__ import annotations

from hashlib import blake2b

from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair


def pair_seed(pair: FragmentPair, seed: int = 0) -> int:
    """A 63-bit seed from a pair and the configured seed."""
    return _digest(f"{seed}|{pair.source}|{pair.target}") >> 1


def shard_of(pair: FragmentPair, count: int) -> int:
    """Which of `count` registration nodes answers a pair, 0..count-1.

    Raises:
        InputError: the count is not positive.
    """
    if count < 1:
        raise InputError(f"Pairs can be shared by one or more nodes, not by {count}.")
    return _digest(f"{pair.source}|{pair.target}") % count


def _digest(text: str) -> int:
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "big")
