"""Pictures of one fragment: its points as small shaded discs, and its depth panorama."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.simulation.panorama import FULL_SCALE, MISSING
from nss_ros.simulation.picture import Image, camera_axes

Array = NDArray[np.float64]

MAX_RANGE = 4.5
"""End of the scale of ranges, metres: the range of the scanner."""

_SAMPLES = 2  # per pixel and direction
_MARGIN = 0.15
_NO_RETURN = 0.88
_EDGE_REACH = 2  # samples
_EDGE_STRENGTH = 2.0


def fragment_picture(
    points: NDArray[np.floating],
    colours: Array,
    width: int = 800,
    disc: float = 0.09,
    top: float = 0.6,
    azimuth: float = 65.0,
    elevation: float = 48.0,
) -> Image:
    """Points seen obliquely from above without perspective, nearer edges set off by dark lines.

    Args:
        points: (n, 3) metres, sensor frame.
        colours: (n, 3), 0..1, of `normal_colours` or `range_colours`.
        width: pixels; the height follows.
        disc: diameter of a point, metres; a little more than the voxel size closes the surfaces.
        top: z above which points are left out, so that ceilings do not hide the rest, metres.
        azimuth: heading of the look, degrees from x to y.
        elevation: of the eye above the horizon, degrees.

    Raises:
        InputError: no point is left.
    """
    kept = points[:, 2] <= top
    if not kept.any():
        raise InputError(f"A picture needs points: there is none up to {top} m above the sensor.")
    right, up, forward = camera_axes(azimuth, -elevation)
    seen = points[kept].astype(np.float64) @ np.stack((right, up, forward), axis=1)
    low, high = seen[:, :2].min(axis=0) - _MARGIN, seen[:, :2].max(axis=0) + _MARGIN
    scale = width * _SAMPLES / (high[0] - low[0])
    height = max(1, round((high[1] - low[1]) * scale / _SAMPLES))
    shape = (height * _SAMPLES, width * _SAMPLES)
    places = np.stack(((high[1] - seen[:, 1]) * scale, (seen[:, 0] - low[0]) * scale), axis=1)
    nearest = _nearest(places, seen[:, 2], shape, disc / 2 * scale)
    depth = np.where(nearest < 0, seen[:, 2].max() + 1.0, seen[nearest, 2])
    image = np.where(nearest[..., None] < 0, 1.0, colours[kept][nearest])
    image[nearest >= 0] *= _edge_light(depth)[nearest >= 0, None]
    pixels = image.reshape(height, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))
    return np.asarray(np.rint(255 * np.clip(pixels, 0.0, 1.0)), dtype=np.uint8)


def normal_colours(normals: NDArray[np.floating]) -> Array:
    """Soft colours of the directions of unit normals (n, 3): one per side, (n, 3) in 0..1."""
    return np.asarray(
        0.68 + np.asarray(normals, dtype=np.float64)[:, [0, 2, 1]] * (0.26, 0.1, 0.26)
    )


def range_colours(points: NDArray[np.floating], max_range: float = MAX_RANGE) -> Array:
    """Viridis by the distance of points (n, 3) from the sensor, near ones bright, (n, 3)."""
    return _viridis(np.linalg.norm(points, axis=1), max_range)


def panorama_picture(
    panorama: NDArray[np.uint16], width: int = 1024, max_range: float = MAX_RANGE
) -> Image:
    """A depth panorama in viridis, near ones bright, grey where there is no return.

    Args:
        panorama: (h, w), as `nss_ros.simulation.panorama` defines it.
        width: pixels, of square pixels of the panorama.
        max_range: end of the colours, metres.

    Raises:
        InputError: the panorama is empty.
    """
    if panorama.ndim != 2 or 0 in panorama.shape:
        raise InputError(f"A depth panorama needs rows and columns, not shape {panorama.shape}.")
    height = max(1, round(width * panorama.shape[0] / panorama.shape[1]))
    rows = np.arange(height) * panorama.shape[0] // height
    columns = np.arange(width) * panorama.shape[1] // width
    values = panorama[np.ix_(rows, columns)].ravel()
    colours = _viridis(values * (FULL_SCALE / MISSING), max_range)
    colours[values == MISSING] = _NO_RETURN
    return np.asarray(np.rint(255 * colours), dtype=np.uint8).reshape(height, width, 3)


def _viridis(distance: NDArray[np.floating], max_range: float) -> Array:
    from matplotlib import colormaps  # costs half a second

    return np.array(colormaps["viridis"](1 - np.clip(distance / max_range, 0.0, 1.0))[:, :3])


def _nearest(
    places: Array, depth: Array, shape: tuple[int, int], radius: float
) -> NDArray[np.intp]:
    """The point that covers each sample, -1 where there is none, of the shape given.

    Args:
        places: (n, 2) row and column of the points' centres, samples.
        depth: (n,) along the look.
        shape: rows and columns.
        radius: of the discs, samples.
    """
    reach = int(np.ceil(radius))
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)]), axis=-1).reshape(-1, 2)
    offsets = offsets[(offsets**2).sum(axis=1) <= max(radius, 0.5) ** 2]
    # From far to near, so that nearer ones are written over farther ones.
    order = np.argsort(-depth, kind="stable")
    cells = np.floor(places[order]).astype(np.intp)[:, None] + offsets
    inside = ((cells >= 0) & (cells < shape)).all(axis=2)
    covered = np.full(shape, -1, dtype=np.intp)
    points = np.broadcast_to(order[:, None], inside.shape)[inside]
    covered[cells[inside][:, 0], cells[inside][:, 1]] = points
    return covered


def _edge_light(depth: Array) -> Array:
    """Less light where neighbours are nearer to the eye (eye-dome lighting, Boucheny 2009)."""
    behind = np.zeros_like(depth)
    padded = np.pad(depth, _EDGE_REACH, mode="edge")
    rows, columns = depth.shape
    shifts = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)]
    for down, across in shifts:
        top, left = _EDGE_REACH * (1 + down), _EDGE_REACH * (1 + across)
        neighbour = padded[top : top + rows, left : left + columns]
        behind += np.clip(depth - neighbour - 0.05, 0.0, 0.6) / len(shifts)
    return np.asarray(np.exp(-_EDGE_STRENGTH * behind))
