"""Where the scanner of a levelled fragment stood, and how, where its frame does not tell.

What a scanner saw to be empty, and what it could not see, is told from where it stood. That is the
origin of a sensor frame; but scans are also exported with the foot of the tripod as their origin,
or in the frame of a site. The place is found again by what it must be: a place from which nearly
all points can be seen, since each of them was, above floor that it does not see, since no scanner
sees the foot of its own tripod. A scanner that was tilted by some degrees is set upright.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nss_ros.carrier import without_carrier
from nss_ros.fragment import Fragment, clean_points, voxelize
from nss_ros.geometry import (
    Matrix,
    Transform,
    Vector,
    adjoint,
    inverse,
    spherical,
    transform_points,
)
from nss_ros.upright import upright_frame

_VOXEL_SIZE = 0.1
# No scan is larger, metres.
_LARGEST = 1000.0
_ROUGHLY = 5_000
# Directions in which points are compared, as far as floor is not seen too flatly for it, metres.
_ROW, _COLUMN = np.radians(1.5), np.radians(3.0)
_ROWS, _COLUMNS = 120, 120
_REACH = 10.0
# A point is hidden by one in its direction that is so much nearer: a share, and metres.
_NEARER, _MARGIN = 1.15, 0.5
# Of 130 sensor frames of a Matterport no origin had more than 0.06 of the points hidden, of 20 of
# a laser scanner between bare studs 0.32. An origin is doubted from the first share on, from the
# second if hardly any point is below it, and always if it is that far outside of the points.
_DOUBTED, _DOUBTED_LOW = 0.4, 0.07
_BELOW, _FEW, _OUTSIDE = -0.5, 0.05, 3.0
# An origin on the floor is the foot of the tripod, unless another place is better by so much.
_FOOT, _AT_FLOOR = 0.2, 0.4
# Another place must have so much less hidden than an origin amid the points.
_BETTER = 0.7
# Few points near a place speak against it; so does floor within three radii of it, which a tripod
# hides, and a want of it in a ring around that, metres.
_SPARSE = 0.4
_RING, _BARE = (1.3, 2.3), 0.15
_FEET = ((0.4, 0.04), (0.7, 0.04), (1.0, 0.04))
# Height of a tripod, metres, and the penalty for each metre that it is lower or higher.
_TRIPOD, _UNUSUAL = 1.6, 0.03
_HEIGHT_BIN, _FLOOR_THICK = 0.05, 0.125
_PROMINENT, _ABOVE, _MOST_FLOORS = 0.3, 0.3, 3
_COARSEST, _FINEST, _ACROSS = 0.5, 0.1, 30
_KEPT = 8

Array = NDArray[np.float64]


class _Floor(NamedTuple):
    """What may be the floor: its height, and its points (n, 2) from above."""

    height: float
    points: Array


def at_standpoint(fragment: Fragment, search: bool = True) -> tuple[Fragment, Transform]:
    """A fragment as seen from where its scanner stood, and the pose of that in its own frame.

    Seen so, a levelled one is upright, and without what carries the scanner. Of a fragment that is
    not levelled, or without `search`, its own frame is taken for it.
    """
    if not fragment.gravity_aligned:
        return fragment, np.eye(4)
    place = np.eye(4)
    if search:
        place = shift(standpoint(fragment.points)) @ upright_frame(fragment.points)
    points = fragment.points
    if not is_origin(place):
        points = transform_points(inverse(place), points).astype(np.float32)
    return Fragment(fragment.id, without_carrier(points), fragment.gravity_aligned), place


def is_origin(standpoint: Transform) -> bool:
    """Whether a standpoint is the frame that the fragment came in."""
    return bool((standpoint == np.eye(4)).all())


class Standpoints(NamedTuple):
    """Where the scanners of a pair stood, each in the frame that its fragment came in.

    Attributes:
        source: (4, 4) pose of the upright frame at the scanner.
        target: (4, 4) the same.
    """

    source: Transform
    target: Transform

    @property
    def are_origins(self) -> bool:
        """Whether both fragments came in the frames of their sensors."""
        return is_origin(self.source) and is_origin(self.target)

    def transform(self, T_target_source: Transform) -> Transform:
        """`T_target_source` of standpoints, (4, 4), for the frames that the fragments came in."""
        return np.asarray(self.target @ T_target_source @ inverse(self.source))

    def covariance(self, covariance: Matrix) -> Matrix:
        """Its covariance (6, 6), order x y z rx ry rz: a turn shifts what is away from it."""
        moved = adjoint(self.target)
        return np.asarray(moved @ covariance @ moved.T)


def shift(translation: Vector) -> Transform:
    """The transform that moves by (3,) metres and does not turn."""
    result = np.eye(4)
    result[:3, 3] = translation
    return result


def standpoint(points: NDArray[np.floating]) -> Vector:
    """The place (3,) of the scanner, metres; zero unless there is a far better one.

    Args:
        points: (n, 3), metres, z up.
    """
    cloud = voxelize(clean_points(points), _VOXEL_SIZE).astype(np.float64)
    origin = np.zeros(3)
    if len(cloud) == 0 or float(np.ptp(cloud, axis=0).max()) > _LARGEST:
        return origin
    hidden, _ = _hidden_share(cloud, origin)
    lower, upper = np.percentile(cloud, (1, 99), axis=0)
    outside = max(lower.max(), -upper.min()) > _OUTSIDE
    low = not outside and float((cloud[:, 2] < _BELOW).mean()) < _FEW
    doubted = outside or hidden > (_DOUBTED_LOW if low else _DOUBTED)
    floors = _floors(cloud) if doubted else []
    if not floors:
        return origin
    place, penalty = _best_place(cloud, floors)
    foot = min(floors, key=lambda floor: abs(floor.height))
    if low and abs(foot.height) < _AT_FLOOR:
        above = np.array([0.0, 0.0, foot.height + _TRIPOD])
        if _penalties(above[None], cloud, foot)[0] < penalty + _FOOT:
            return above
    better = _hidden_share(cloud, place)[0] < _BETTER * hidden
    return place if outside or low or better else origin


def _best_place(cloud: Array, floors: Sequence[_Floor]) -> tuple[Vector, float]:
    """The most plausible place and its penalty, searched from coarse to fine."""
    rough = cloud[:: -(-len(cloud) // _ROUGHLY)]
    low, high = np.percentile(cloud[:, :2], (2, 98), axis=0)
    coarsest = max(_COARSEST, float((high - low).max()) / _ACROSS)
    x, y = (np.arange(a, b + coarsest, coarsest) for a, b in zip(low, high, strict=True))
    found: list[tuple[Vector, float]] = []
    for floor in floors:
        places, penalties = _best(_grid(x, y, [floor.height + _TRIPOD]), rough, floor)
        step = coarsest
        while step > _FINEST:
            step /= 2
            fine = step < 3 * _FINEST
            moves = _grid((-step, 0, step), (-step, 0, step), (-0.2, 0, 0.2) if fine else (0,))
            near = np.unique((places[:, None] + moves).reshape(-1, 3).round(4), axis=0)
            places, penalties = _best(near, cloud if fine else rough, floor)
        found.append((places[0], float(penalties[0])))
    return min(found, key=lambda each: each[1])


def _grid(*axes: ArrayLike) -> Array:
    """All places (n, 3) with these coordinates."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)


def _best(places: Array, cloud: Array, floor: _Floor) -> tuple[Array, Array]:
    """The best of places (n, 3) and their penalties, the least first."""
    penalties = _penalties(places, cloud, floor)
    order = np.argsort(penalties, kind="stable")[:_KEPT]
    return places[order], penalties[order]


def _penalties(places: Array, cloud: Array, floor: _Floor) -> Array:
    """How implausible places (n, 3) above a floor are, (n,); few near points: beside the others."""
    shares, counts = np.array([_hidden_share(cloud, place) for place in places]).T
    feet = np.array([_floor_at_feet(floor.points, place) for place in places])
    sparse = _SPARSE * (1 - counts / max(float(counts.max()), 1))
    return np.asarray(
        shares + sparse + feet + _UNUSUAL * np.abs(places[:, 2] - floor.height - _TRIPOD)
    )


def _hidden_share(cloud: Array, place: Vector) -> tuple[float, int]:
    """Share of the near points that a scanner at a place would not see, and how many are near."""
    away = cloud - place
    square = (away * away).sum(axis=1)
    near = square < _REACH**2
    count = int(np.count_nonzero(near))
    if count == 0:
        return 1.0, 0
    distance, azimuth, elevation = spherical(away[near])
    cell = np.minimum((elevation / _ROW).astype(np.intp), _ROWS - 1) * _COLUMNS
    cell += np.minimum((azimuth / _COLUMN).astype(np.intp), _COLUMNS - 1)
    nearest = np.full(_ROWS * _COLUMNS, np.inf)
    np.minimum.at(nearest, cell, distance)
    hidden = np.count_nonzero(distance > nearest[cell] * _NEARER + _MARGIN)
    return hidden / count, count


def _floor_at_feet(floor: Array, place: Vector) -> float:
    """Penalty for floor (n, 2) that is seen where a tripod hides it, or not around that."""
    distance = np.hypot(floor[:, 0] - place[0], floor[:, 1] - place[1])
    seen = sum(
        weight * np.count_nonzero(distance < radius) * _VOXEL_SIZE**2 / (np.pi * radius**2)
        for radius, weight in _FEET
    )
    inner, outer = _RING
    around = np.count_nonzero((distance > inner) & (distance < outer)) * _VOXEL_SIZE**2
    return seen + _BARE * (1 - min(1.0, around / (np.pi * (outer**2 - inner**2))))


def _floors(cloud: Array) -> list[_Floor]:
    """What may be the floor: the lowest of the heights at which many points are, others above."""
    heights = cloud[:, 2]
    edges = np.arange(heights.min() - 0.2, heights.max() + 0.25, _HEIGHT_BIN)
    counts = np.convolve(np.histogram(heights, edges)[0], np.ones(3), "same")
    peak = np.r_[False, (counts[1:-1] > counts[:-2]) & (counts[1:-1] >= counts[2:]), False]
    above = 1 - np.cumsum(counts) / counts.sum()
    peak &= (counts >= _PROMINENT * counts.max()) & (above > _ABOVE)
    found = edges[:-1][peak] + _HEIGHT_BIN / 2
    return [
        _Floor(float(height), cloud[np.abs(heights - height) < _FLOOR_THICK, :2])
        for height in found[:_MOST_FLOORS]
    ]
