"""How much a fragment's surface bends: the geometric complexity of the NSS paper.

The surface variation of a point is lambda_0 / (lambda_0 + lambda_1 + lambda_2), lambda_0 the
smallest eigenvalue of the covariance of all points within a radius of it, itself included
(Pauly et al. 2002, Efficient simplification of point-sampled surfaces). It is 0 on a plane and
1/3 where nothing is preferred. A fragment's geometric complexity is the mean over its points
(Sun et al. 2023, arXiv 2311.09346, with a radius of 0.5 m).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nss_ros.dataset.overlap import finite_points
from nss_ros.errors import InputError

_DISTANCES_AT_ONCE = 4_000_000
_MOST_CELLS = 2.0**62  # they are numbered by int64
_CELL_SIZE = 1.5  # in radii: with smaller ones the calls take longer than what they compute
_SLACK = 1e-10  # rounding of squared distances, as a share of the radius squared
_ROW, _COLUMN = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)  # upper triangle of a covariance


def geometric_complexity(points: NDArray[np.floating], radius: float = 0.5) -> float:
    """Mean surface variation of a fragment's points; NaN for a fragment without points.

    Args:
        points: (n, 3), metres.
        radius: of the neighbourhoods, metres.

    Raises:
        InputError: the points are not (n, 3) or not finite, or the radius is not positive.
    """
    variation = surface_variation(points, radius)
    return float(variation.mean()) if len(variation) else float("nan")


def surface_variation(points: NDArray[np.floating], radius: float = 0.5) -> NDArray[np.float64]:
    """Surface variation of every point, (n,) in [0, 1/3]; 0 where all neighbours coincide.

    Args:
        points: (n, 3), metres.
        radius: of the neighbourhoods, metres; a point at just this distance counts.

    Raises:
        InputError: the points are not (n, 3) or not finite, or the radius is not positive.
    """
    points = finite_points(points)
    if not radius > 0:
        raise InputError(f"The radius of a neighbourhood must be positive, not {radius} m.")
    if len(points) == 0:
        return np.zeros(0)
    eigenvalues = np.linalg.eigvalsh(_covariances(_neighbourhood_sums(points, radius)))
    eigenvalues = np.maximum(eigenvalues, 0.0)  # rounding makes zeros negative
    total = eigenvalues.sum(axis=1)
    variation = np.zeros(len(points))
    np.divide(eigenvalues[:, 0], total, out=variation, where=total > 0)
    return variation


def _covariances(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    means = sums[:, 1:] / sums[:, :1]
    entries = means[:, 3:] - means[:, _ROW] * means[:, _COLUMN]
    covariances = np.empty((len(sums), 3, 3))
    covariances[:, _ROW, _COLUMN] = covariances[:, _COLUMN, _ROW] = entries
    return covariances


def _neighbourhood_sums(points: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Sums over each point's neighbours of 1, x, y, z and the products of coordinates, (n, 10).

    Points are taken by cells no smaller than the radius, so that the neighbours of all points of
    a cell lie in 27 cells and one matrix product sums them; several times faster than lists of
    neighbours.
    """
    keys, row, layer = _cell_keys(points, radius)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    centred = points[order] - points.mean(axis=0)  # large coordinates would cancel digits
    moments = np.column_stack(
        (np.ones(len(points)), centred, centred[:, _ROW] * centred[:, _COLUMN])
    )
    cells, starts = np.unique(keys, return_index=True)
    ends = np.append(starts[1:], len(keys)).tolist()
    columns = cells[:, None] + np.array(
        [x * layer + y * row for x in (-1, 0, 1) for y in (-1, 0, 1)]
    )
    first = np.searchsorted(keys, columns - 1, side="left").tolist()
    last = np.searchsorted(keys, columns + 1, side="right").tolist()
    middles, halves = _boxes(centred, starts)
    squared_distances = _squared_distances(centred, radius)
    axes = np.ascontiguousarray(centred.T)
    sums = np.empty_like(moments)
    for cell, (start, end) in enumerate(zip(starts.tolist(), ends, strict=True)):
        near = np.concatenate(
            [np.arange(a, b) for a, b in zip(first[cell], last[cell], strict=True) if b > a]
        )
        # Only those that the box around the cell's points is within reach of.
        beyond = np.abs(axes.take(near, axis=1) - middles[cell])
        beyond -= halves[cell]
        np.maximum(beyond, 0, out=beyond)
        beyond *= beyond
        near = near[beyond.sum(axis=0) <= radius**2 * (1 + _SLACK)]
        step = max(1, _DISTANCES_AT_ONCE // len(near))
        for begin in range(start, end, step):
            rows = slice(begin, min(begin + step, end))
            met = squared_distances(rows, near) <= radius**2 * (1 + _SLACK)
            sums[order[rows]] = met.astype(np.float64) @ moments.take(near, axis=0)
    return sums


def _boxes(
    points: NDArray[np.float64], starts: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles and half extents, (m, 3, 1), of the boxes around points (n, 3) from each start on."""
    low, high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    return ((low + high) / 2)[..., None], ((high - low) / 2)[..., None]


def _squared_distances(
    points: NDArray[np.float64], radius: float
) -> Callable[[slice, NDArray[np.intp]], NDArray[np.float64]]:
    """What gives squared distances of some points from others, by their rows."""

    def by_product(rows: slice, others: NDArray[np.intp]) -> NDArray[np.float64]:
        return np.asarray(left[rows] @ right.take(others, axis=1))

    def by_differences(rows: slice, others: NDArray[np.intp]) -> NDArray[np.float64]:
        apart = axes[:, rows, None] - axes.take(others, axis=1)[:, None]
        return np.asarray(np.square(apart).sum(axis=0))

    axes, ones = np.ascontiguousarray(points.T), np.ones(len(points))
    squares = np.square(axes).sum(axis=0)
    left = np.stack((*(-2 * axes), squares, ones), axis=1)
    right = np.stack((*axes, ones, squares))
    # The product loses digits of large coordinates, and must not lose a point at just the radius.
    return by_product if squares.max() * 1e-14 <= radius**2 * _SLACK else by_differences


def _cell_keys(points: NDArray[np.float64], radius: float) -> tuple[NDArray[np.int64], int, int]:
    """Numbers of the points' cells, and what they grow by along y and along x (1 along z)."""
    cells = np.floor((points - points.min(axis=0)) / (_CELL_SIZE * radius)) + 1
    extent = cells.max(axis=0) + 2  # an empty cell on each side
    if extent.prod() > _MOST_CELLS:
        raise InputError(
            f"A point cloud of {np.ptp(points, axis=0).max():.3g} m across is too large for "
            f"neighbourhoods of {radius} m: remove points that are far off."
        )
    x, y, z = cells.astype(np.int64).T
    row = int(extent[2])
    layer = int(extent[1]) * row
    return x * layer + y * row + z, row, layer
