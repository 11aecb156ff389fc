"""Tripods of one stage stand apart: nobody scans twice from one place.

Where rooms are alike, a wrong pose puts fragments into a room that others of their stage are from,
and nothing that they see contradicts it. But among so many places some are then the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from nss_ros.geometry import Transform
from nss_ros.multiway.spanning_tree import Poses

# Nearer than this is the same place, metres. The paper's spots are 1 to 4 m apart.
_SAME_PLACE = 0.8
# What a pair that is that near loses, logarithm of the odds.
_LOSS = 5.0
# Who scans without such care has this share, at least, of what chance would put there, of pairs
# that are not farther apart than so many metres.
_CHANCE, _AROUND = 0.5, 4.0


def loss_on_same_place(transforms: Iterable[Transform]) -> float:
    """What two fragments of one stage on the same place lose in a map, logarithm of the odds.

    Nothing where fragments are often on one place, as those of a camera in somebody's hand are.

    Args:
        transforms: `T_target_source` of pairs within a stage that are surely right.
    """
    distances = np.array([float(np.linalg.norm(each[:3, 3])) for each in transforms])
    expected = (_SAME_PLACE / _AROUND) ** 2 * (distances < _AROUND).sum()
    seen = (distances < _SAME_PLACE).sum()
    return _LOSS if seen <= _CHANCE * expected else 0.0


def on_same_place(transform: Transform) -> bool:
    """Whether the origins of two frames are on the same place."""
    return math.hypot(*transform[:3, 3]) < _SAME_PLACE


def count_on_same_place(one: Poses, other: Poses, transform: Transform) -> int:
    """Pairs of fragments of one stage, one in each part, that a link puts on the same place.

    Args:
        one: a part.
        other: another.
        transform: from the frame of the other to that of the one.
    """
    places, moved = _places(one), _places(other) @ transform[:3, :3].T + transform[:3, 3]
    near = np.linalg.norm(moved[:, None] - places, axis=2) < _SAME_PLACE
    stages = [np.array([id_.stage for id_ in part]) for part in (other, one)]
    return int((near & (stages[0][:, None] == stages[1])).sum())


def _places(part: Poses) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([pose[:3, 3] for pose in part.values()])
