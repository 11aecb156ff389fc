"""The floor that fragments have seen, in plan."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform, transform_points

CELL_SIZE = 0.25
"""Metres."""

_SECTORS = 120  # about one cell wide at the range of the scanner
_OFFSET = 1 << 31  # cells are numbered from there, so that none is negative


def floor_area(fragments: Iterable[tuple[NDArray[np.floating], Transform]]) -> float:
    """The floor that at least one fragment has seen, free or taken, square metres.

    A fragment sees the cells of 0.25 m from the scanner to its farthest return in their direction,
    at whatever height: free floor, and what stands on it. What no return comes from, such as a
    shaft or a locked room, does not count.

    Args:
        fragments: points (n, 3) in metres, sensor frame, and `T_map_fragment` of each.
    """
    seen: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    for points, T_map_fragment in fragments:
        seen = np.union1d(seen, _seen_cells(points, T_map_fragment))
    return len(seen) * CELL_SIZE**2


def _seen_cells(points: NDArray[np.floating], T_map_fragment: Transform) -> NDArray[np.int64]:
    """Numbers of the cells that a fragment sees."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    plan = transform_points(T_map_fragment, points)[:, :2]
    spot = T_map_fragment[:2, 3]
    reach = np.zeros(_SECTORS)
    np.maximum.at(reach, _sector(plan - spot), np.linalg.norm(plan - spot, axis=1))
    low, high = (
        np.floor((spot + way * reach.max()) / CELL_SIZE).astype(np.int64) for way in (-1, 1)
    )
    columns, rows = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    cells = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2)
    centres = (cells + 0.5) * CELL_SIZE - spot
    within = np.linalg.norm(centres, axis=1) <= reach[_sector(centres)]
    column, row = cells[within].T + _OFFSET
    return np.unique((column << 32) + row)


def _sector(offsets: NDArray[np.float64]) -> NDArray[np.intp]:
    angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    return (np.floor(angles / (2 * np.pi) * _SECTORS).astype(np.intp)) % _SECTORS
