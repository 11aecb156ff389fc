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
# Per corner of a box, whether it is the lower (0) or the upper end along x, y and z.
_BOX_CORNERS = np.array([(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])


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


def boxes(lower: ArrayLike, upper: ArrayLike) -> Mesh:
    """Many axis-aligned boxes as one mesh; those without a volume are left out.

    Args:
        lower: (n, 3) or what broadcasts to it, metres.
        upper: the opposite corners, likewise.
    """
    low, high = np.broadcast_arrays(np.asarray(lower, float), np.asarray(upper, float))
    low, high = low.reshape(-1, 3), high.reshape(-1, 3)
    solid = (low < high).all(axis=1)
    ends = np.stack((low[solid], high[solid]), axis=1)
    vertices = np.stack([ends[:, _BOX_CORNERS[:, k], k] for k in range(3)], axis=-1)
    offsets = np.arange(len(ends), dtype=np.int32) * 8
    return Mesh(vertices.reshape(-1, 3), _repeated(_BOX_TRIANGLES, offsets))


def standing_box(length: float, width: float, bottom: float, top: float) -> Mesh:
    """A box centred on the z axis between two heights."""
    return box((-length / 2, -width / 2, bottom), (length / 2, width / 2, top))


def cylinder(start: ArrayLike, end: ArrayLike, radius: float, sides: int = 10) -> Mesh:
    """A closed cylinder between the centres of its two ends."""
    return cylinders(start, end, radius, sides)


def cylinders(start: ArrayLike, end: ArrayLike, radius: ArrayLike, sides: int = 10) -> Mesh:
    """Many closed cylinders as one mesh.

    Args:
        start: (n, 3) centres of one end, or what broadcasts to it, metres.
        end: centres of the other, likewise.
        radius: one for all or one each, metres.
        sides: of the polygon that stands for the circle.
    """
    starts, ends = np.broadcast_arrays(np.asarray(start, float), np.asarray(end, float))
    starts, ends = starts.reshape(-1, 3), ends.reshape(-1, 3)
    axes = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    first = np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axes, first)
    angles = (np.arange(sides) * (2 * np.pi / sides))[:, None]
    rim = np.cos(angles) * first[:, None] + np.sin(angles) * second[:, None]
    rim *= np.broadcast_to(np.asarray(radius, float), len(starts))[:, None, None]
    rings = (starts[:, None] + rim, ends[:, None] + rim, starts[:, None], ends[:, None])
    vertices = np.concatenate(rings, axis=1).reshape(-1, 3)
    offsets = np.arange(len(starts), dtype=np.int32) * (2 * sides + 2)
    return Mesh(vertices, _repeated(_cylinder_triangles(sides), offsets))


def _cylinder_triangles(sides: int) -> NDArray[np.int32]:
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
    return triangles.astype(np.int32)


def _repeated(triangles: NDArray[np.int32], offsets: NDArray[np.int32]) -> NDArray[np.int32]:
    """The triangles of one solid once per copy, whose vertices begin at the offsets."""
    return np.asarray((offsets[:, None, None] + triangles).reshape(-1, 3), dtype=np.int32)


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
        pieces.append(((opening.start, y0, bottom), (opening.end, y1, min(opening.bottom, top))))
        pieces.append(((opening.start, y0, max(opening.top, bottom)), (opening.end, y1, top)))
        start = opening.end
    pieces.append(((start, y0, bottom), (length, y1, top)))
    corners = np.array(pieces)
    return boxes(corners[:, 0], corners[:, 1])


def slab(
    lower: tuple[float, float, float],
    upper: tuple[float, float, float],
    holes: Sequence[tuple[float, float, float, float]] = (),
) -> Mesh:
    """A level slab pierced by rectangular holes.

    Args:
        lower: its lower corner.
        upper: its upper corner.
        holes: (x0, y0, x1, y1) of each; they may reach beyond the slab.
    """
    (x0, y0, bottom), (x1, y1, top) = lower, upper
    xs = np.unique(np.clip([x0, x1, *(x for h in holes for x in (h[0], h[2]))], x0, x1))
    ys = np.unique(np.clip([y0, y1, *(y for h in holes for y in (h[1], h[3]))], y0, y1))
    low = np.stack(np.meshgrid(xs[:-1], ys[:-1], [bottom], indexing="ij"), -1).reshape(-1, 3)
    high = np.stack(np.meshgrid(xs[1:], ys[1:], [top], indexing="ij"), -1).reshape(-1, 3)
    middle = (low + high) / 2
    solid = np.ones(len(low), dtype=bool)
    for hx0, hy0, hx1, hy1 in holes:
        inside_x = (middle[:, 0] > hx0) & (middle[:, 0] < hx1)
        solid &= ~(inside_x & (middle[:, 1] > hy0) & (middle[:, 1] < hy1))
    return boxes(low[solid], high[solid])


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
