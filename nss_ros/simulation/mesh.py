"""Triangle meshes of simple solids, metres, z up, outward normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nss_ros.geometry import Transform, transform_points

_BOX_TRIANGLES = np.array(
    [
        *([0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4]),
        *([1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]),
    ],
    dtype=np.int32,
)


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (n, 3) float64, metres.
        triangles: (m, 3) int32, indices of vertices.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Opening:
    """A rectangular hole in a wall, metres along the wall and above the floor."""

    start: float
    end: float
    bottom: float
    top: float


def box(lower: ArrayLike, upper: ArrayLike) -> Mesh:
    """An axis-aligned box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(lower, float), np.asarray(upper, float)
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    corners = [(*xy, z) for z in (z0, z1) for xy in ring]
    return Mesh(np.array(corners), _BOX_TRIANGLES)


def standing_box(length: float, width: float, bottom: float, top: float) -> Mesh:
    """A box centred on the z axis between two heights."""
    return box((-length / 2, -width / 2, bottom), (length / 2, width / 2, top))


def cylinder(start: ArrayLike, end: ArrayLike, radius: float, sides: int = 10) -> Mesh:
    """A closed cylinder between the centres of its two ends."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = (end - start) / np.linalg.norm(end - start)
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    angles = np.arange(sides) * (2 * np.pi / sides)
    rim = radius * (np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second))
    vertices = np.concatenate((start + rim, end + rim, [start], [end]))
    near = np.arange(sides)
    following = (near + 1) % sides
    far, far_following = near + sides, following + sides
    triangles = np.concatenate(
        [
            np.stack((near, following, far_following), axis=1),
            np.stack((near, far_following, far), axis=1),
            np.stack((following, near, np.full(sides, 2 * sides)), axis=1),
            np.stack((far, far_following, np.full(sides, 2 * sides + 1)), axis=1),
        ]
    )
    return Mesh(vertices, triangles.astype(np.int32))


def mound(radius: float, height: float, rng: np.random.Generator, sides: int = 14) -> Mesh:
    """An irregular heap on the floor around the z axis."""
    rings = np.array([1.0, 0.75, 0.5, 0.25])
    angles = np.arange(sides) * (2 * np.pi / sides)
    radii = radius * rings[:, None] * rng.uniform(0.75, 1.0, (len(rings), sides))
    heights = height * (1 - rings[:, None]) * rng.uniform(0.6, 1.2, (len(rings), sides))
    vertices = np.stack((radii * np.cos(angles), radii * np.sin(angles), heights), axis=-1)
    triangles = []
    following = (np.arange(sides) + 1) % sides
    for ring in range(len(rings) - 1):
        outer, inner = ring * sides, (ring + 1) * sides
        here = np.arange(sides)
        triangles.append(np.stack((outer + here, outer + following, inner + following), axis=1))
        triangles.append(np.stack((outer + here, inner + following, inner + here), axis=1))
    last = (len(rings) - 1) * sides
    top = np.full(sides, len(rings) * sides)
    triangles.append(np.stack((last + np.arange(sides), last + following, top), axis=1))
    return Mesh(
        np.concatenate((vertices.reshape(-1, 3), [(0.0, 0.0, height)])),
        np.concatenate(triangles).astype(np.int32),
    )


def wall(
    length: float,
    lower: tuple[float, float],
    upper: tuple[float, float],
    openings: Sequence[Opening] = (),
) -> Mesh:
    """A wall along x from 0 to `length`, pierced by openings.

    Args:
        length: metres.
        lower: y of one face and z of the bottom.
        upper: y of the other face and z of the top.
        openings: apart from one another along x.
    """
    (y0, bottom), (y1, top) = lower, upper
    pieces = []
    start = 0.0
    for opening in sorted(openings, key=lambda o: o.start):
        pieces.append(((start, y0, bottom), (opening.start, y1, top)))
        pieces.append(((opening.start, y0, bottom), (opening.end, y1, opening.bottom)))
        pieces.append(((opening.start, y0, opening.top), (opening.end, y1, top)))
        start = opening.end
    pieces.append(((start, y0, bottom), (length, y1, top)))
    return merge([box(a, b) for a, b in pieces if all(p < q for p, q in zip(a, b, strict=True))])


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    if not meshes:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(triangles).astype(np.int32),
    )


def moved(mesh: Mesh, transform: Transform) -> Mesh:
    """A mesh moved by a transform."""
    return Mesh(transform_points(transform, mesh.vertices), mesh.triangles)
