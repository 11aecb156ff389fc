"""Where a wall is solid, and where its doors and windows are, from its mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.simulation.mesh import Mesh

_NARROW = 1e-3  # columns narrower than this are of rounding, metres
_MOST_COLUMNS = 2000
_LEAST_HEIGHT = 0.05  # of a piece of wall, metres
_OFF_CENTRE = 0.4871  # no edge of a triangle lies at this share of a wall's thickness


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangular piece of a wall, metres along it from its start and above its foot."""

    start: float
    end: float
    bottom: float
    top: float


def panels(mesh: Mesh, size: NDArray[np.float64]) -> list[Panel]:
    """The pieces that a wall is made of, from one end to the other; openings are left out.

    The wall is cut into columns at its corners, and a vertical line in the middle of each tells
    where it is solid. A mesh that is not closed counts as solid all over.

    Args:
        mesh: the wall, x along it from 0, y across, z up from 0, metres.
        size: (3,) of the box around it, metres.
    """
    whole = [Panel(0.0, float(size[0]), 0.0, float(size[2]))]
    edges = np.unique(np.round(np.clip(mesh.vertices[:, 0], 0.0, size[0]), 4))
    edges = edges[np.append(True, np.diff(edges) > _NARROW)]
    edges[-1] = size[0]
    if not 2 <= len(edges) <= _MOST_COLUMNS:
        return whole
    crossings = _crossings(mesh, (edges[:-1] + edges[1:]) / 2, size[1] * _OFF_CENTRE)
    if any(len(heights) % 2 for heights in crossings) or not any(map(len, crossings)):
        return whole
    found = []
    for start, end, heights in zip(edges[:-1].tolist(), edges[1:].tolist(), crossings, strict=True):
        for bottom, top in heights.reshape(-1, 2).tolist():
            if top - bottom >= _LEAST_HEIGHT:
                found.append(Panel(start, end, round(bottom, 4), round(top, 4)))
    return found or whole


def _crossings(mesh: Mesh, xs: NDArray[np.float64], y: float) -> list[NDArray[np.float64]]:
    """Heights at which vertical lines at (x, y) cross the mesh, sorted, one array per x."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    found = []
    for x in xs.tolist():
        near = np.flatnonzero(
            (np.minimum(np.minimum(a[:, 0], b[:, 0]), c[:, 0]) <= x)
            & (np.maximum(np.maximum(a[:, 0], b[:, 0]), c[:, 0]) >= x)
        )
        p, q, r = a[near], b[near], c[near]
        # Barycentric coordinates of (x, y) in the triangle seen from above.
        area = _cross(q - p, r - p)
        level = np.abs(area) > 1e-12  # upright ones are not crossed
        p, q, r, area = p[level], q[level], r[level], area[level]
        place = np.array([x, y, 0.0])
        u = _cross(r - q, place - q) / area
        v = _cross(p - r, place - r) / area
        w = 1.0 - u - v
        hit = (u >= 0) & (v >= 0) & (w >= 0)
        heights = u[hit] * p[hit, 2] + v[hit] * q[hit, 2] + w[hit] * r[hit, 2]
        found.append(np.sort(heights))
    return found


def _cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
