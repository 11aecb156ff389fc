"""Equirectangular 16-bit depth panoramas, as in the NSS release.

A value is round(range / 10 m * 65535). Row i of h lies at latitude linspace(pi/2, -pi/2, h)[i],
column j of w at longitude linspace(0, 2 pi, w)[j], both ends included, and a range d there is
the point (-d cos(lat) sin(lon), d cos(lat) cos(lon), d sin(lat)) in the sensor frame: the
convention of the release's tool `pan_to_pcd.py`. A pixel without a return is 65535, farther than
any cut of that tool.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import Points

FULL_SCALE = 10.0
"""Range of the largest value, metres."""
MISSING = 65535
"""The largest value: no return."""

_SAME_SURFACE = 0.05
"""Most difference, as a share of the range, between two neighbours that close a hole."""


def panorama(points: Points, height: int) -> NDArray[np.uint16]:
    """The panorama (height, 2 * height) of points: in every pixel the nearest one.

    Single pixels between two neighbours on one surface, left and right or above and below, get
    the mean of the two.

    Args:
        points: (n, 3), metres, sensor frame; those beyond 10 m are left out.
        height: rows.
    """
    width = 2 * height
    x, y, z = np.asarray(points, dtype=np.float64).T
    flat = np.sqrt(x * x + y * y)  # several times faster than np.hypot
    ranges = np.sqrt(flat * flat + z * z)
    rows = np.rint((np.pi / 2 - np.arctan2(z, flat)) / np.pi * (height - 1)).astype(np.int64)
    turn = np.arctan2(-x, y)
    turn[turn < 0] += 2 * np.pi
    columns = np.rint(turn / (2 * np.pi) * (width - 1)).astype(np.int64)
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, rows * width + columns, ranges)
    image = nearest.reshape(height, width)
    image[:, 0] = image[:, -1] = np.minimum(image[:, 0], image[:, -1])  # one direction
    image = _without_single_holes(image)
    seen = np.flatnonzero(image < FULL_SCALE)
    values = np.full(image.shape, MISSING, dtype=np.uint16)
    scaled = np.rint(image.reshape(-1).take(seen) / FULL_SCALE * MISSING)
    values.reshape(-1)[seen] = np.minimum(scaled, MISSING - 1)
    return values


def panorama_points(ranges: NDArray[np.floating], cut: float) -> Points:
    """Points (n, 3) float32 of the pixels of a panorama up to a range, sensor frame, in metres.

    Args:
        ranges: (h, w) metres, inf where there is no return.
        cut: largest range, metres; the release's clouds have 4.5.
    """
    rows, columns = np.nonzero(ranges <= cut)
    height, width = ranges.shape
    latitude = np.linspace(np.pi / 2, -np.pi / 2, height)[rows]
    longitude = np.linspace(0, 2 * np.pi, width)[columns]
    distance = ranges[rows, columns]
    level = distance * np.cos(latitude)
    points = (-level * np.sin(longitude), level * np.cos(longitude), distance * np.sin(latitude))
    return np.stack(points, axis=1).astype(np.float32)


def panorama_ranges(image: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Ranges (h, w) of a panorama, metres; inf where there is no return."""
    return np.where(image == MISSING, np.inf, image / MISSING * FULL_SCALE)


def _without_single_holes(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The image with pixels between two of one surface filled; inf is missing."""
    filled = image.copy()
    missing = np.isinf(image)
    turns = image.shape[1] - 1  # the last column is the first
    level = np.pad(~missing[:, :-1], ((0, 0), (1, 2)), mode="wrap")
    upright = np.pad(~missing, ((1, 1), (0, 0)))
    for step, between in (
        ((0, 1), level[:, :-2] & level[:, 2:]),
        ((1, 0), upright[:-2] & upright[2:]),
    ):
        rows, columns = np.nonzero(missing & between)
        one, other = (
            image[rows + sign * step[0], (columns + sign * step[1]) % turns] for sign in (-1, 1)
        )
        near, far = np.minimum(one, other), np.maximum(one, other)
        same = far - near <= _SAME_SURFACE * near
        rows, columns = rows[same], columns[same]
        filled[rows, columns] = (near[same] + far[same]) / 2
        missing[rows, columns] = False
    return filled
