"""How much two fragments overlap, and how much of that has changed.

Both figures are of the NSS paper's pairwise dataset (Sun et al. 2023, arXiv 2311.09346) with
tau = 0.2 m. The text of the paper's formulas was not available when this was written; what is
certain is that each edge of the challenge's graphs carries one `overlap` and one
`temporal_change`, both in [0, 1], with the source before the target in the order of the nodes,
and that the temporal change ratio is taken within convex hulls. The formulas below are our
reading of that:

- overlap ratio: the share of source points that have a target point within tau after
  ground-truth alignment; it is not symmetric, so it is given in both directions.
- temporal change ratio: of all points of both fragments that lie in the convex hull of the
  other, the share without a point of the other within tau; it is symmetric. What one fragment
  does not see because it is hidden counts as changed, so same-stage pairs are not at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from nss_ros.dataset.proximity_grid import FAR, MET, NEAR, ProximityGrid, proximity_grid
from nss_ros.errors import InputError
from nss_ros.geometry import Transform, inverse, relative, transform_points

_HULL_TOLERANCE = 1e-9  # of barycentric coordinates


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points in their own frame with what every pair of them needs.

    Attributes:
        points: (n, 3) metres, finite; kept as float64.
        axes: (3, n) the same, a row per axis.
        tree: of the points.
        hull: tetrahedra that fill the convex hull; None for flat or tiny clouds.
        radius: largest distance of a point from the origin of its frame, metres.

    Raises:
        InputError: the points are not (n, 3) or not finite.
    """

    points: NDArray[np.floating]
    axes: NDArray[np.float64] = field(init=False)
    tree: cKDTree = field(init=False)
    hull: Delaunay | None = field(init=False)
    radius: float = field(init=False)
    _grids: dict[float, ProximityGrid | None] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        points = finite_points(self.points)
        axes = np.ascontiguousarray(points.T)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "axes", axes)
        # Built in half the time, and no slower to search.
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
        object.__setattr__(self, "tree", tree)
        object.__setattr__(self, "hull", _hull(points))
        radius = float(np.sqrt(np.square(axes).sum(axis=0).max(initial=0.0)))
        object.__setattr__(self, "radius", radius)

    def labels(
        self, source: Cloud, T_self_source: Transform, tau: float
    ) -> NDArray[np.uint8] | None:
        """What the grid for tau says of another cloud's points, (n,); None without a grid."""
        if tau not in self._grids:
            self._grids[tau] = proximity_grid(self.axes, tau)
        grid = self._grids[tau]
        return None if grid is None else grid.at(T_self_source, source.axes)

    def met(
        self, positions: NDArray[np.float64], labels: NDArray[np.uint8] | None, tau: float
    ) -> NDArray[np.bool_]:
        """Which positions (n, 3) have a point within tau, given their labels if there are any."""
        if labels is None:
            return _has_neighbour(positions, self.tree, tau)
        result = np.asarray(labels == MET)
        near = np.flatnonzero(labels == NEAR)
        result[near] = _has_neighbour(positions.take(near, axis=0), self.tree, tau)
        return result


@dataclass(frozen=True, slots=True)
class PairOverlap:
    """The ratios of a pair; see the module.

    Attributes:
        overlap_ratio: share of source points with a target point within tau.
        temporal_change: NaN where no point lies in the hull of the other.
        reverse_overlap_ratio: share of target points with a source point within tau.
    """

    overlap_ratio: float
    temporal_change: float
    reverse_overlap_ratio: float


def finite_points(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """The points as float64.

    Raises:
        InputError: they are not (n, 3) or not finite.
    """
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"A point cloud must be an array of shape (n, 3), not {array.shape}.")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise InputError(
            f"A point cloud holds {bad} points that are not finite: remove them before it is "
            "measured."
        )
    return array


def pair_overlap(
    source: Cloud, target: Cloud, T_target_source: Transform, tau: float = 0.2
) -> PairOverlap:
    """All ratios of one pair.

    Args:
        source: the source's points.
        target: the target's points.
        T_target_source: ground truth.
        tau: metres.

    Returns:
        Overlap ratios (0 for an empty fragment) and temporal change ratio.

    Raises:
        InputError: tau is not positive.
    """
    figures = overlap_of_at_least(source, target, T_target_source, 0.0, tau)
    assert figures is not None  # every ratio is at least 0
    return figures


def overlap_of_at_least(
    source: Cloud, target: Cloud, T_target_source: Transform, least: float, tau: float = 0.2
) -> PairOverlap | None:
    """All ratios of one pair, or None if both overlap ratios are below a limit.

    Cheaper than `pair_overlap` where little overlaps: a look at coarse cells is often enough.

    Args:
        source: the source's points.
        target: the target's points.
        T_target_source: ground truth.
        least: limit of the larger overlap ratio.
        tau: metres.

    Raises:
        InputError: tau is not positive.
    """
    if not tau > 0:
        raise InputError(f"The overlap distance tau must be positive, not {tau} m.")
    T_source_target = inverse(T_target_source)
    source_labels = target.labels(source, T_target_source, tau)
    target_labels = source.labels(target, T_source_target, tau)
    if max(_most(source_labels), _most(target_labels)) < least:
        return None
    source_in_target = transform_points(T_target_source, source.points)
    target_in_source = transform_points(T_source_target, target.points)
    source_met = target.met(source_in_target, source_labels, tau)
    target_met = source.met(target_in_source, target_labels, tau)
    overlap, reverse = _share(source_met), _share(target_met)
    if max(overlap, reverse) < least:
        return None
    shared = np.concatenate(
        (
            source_met[_inside(source_in_target, target.hull)],
            target_met[_inside(target_in_source, source.hull)],
        )
    )
    change = 1 - _share(shared) if len(shared) else float("nan")
    return PairOverlap(overlap, change, reverse)


def all_overlaps(
    clouds: Sequence[Cloud], poses: Sequence[Transform], tau: float = 0.2
) -> dict[tuple[int, int], PairOverlap]:
    """Ratios of all pairs (source before target) that can touch, by the indices of the clouds.

    Args:
        clouds: fragments in their own frames.
        poses: `T_map_fragment` of each.
        tau: metres.
    """
    overlaps = {}
    for i, source in enumerate(clouds):
        for j in range(i + 1, len(clouds)):
            distance = float(np.linalg.norm(poses[i][:3, 3] - poses[j][:3, 3]))
            if distance <= source.radius + clouds[j].radius + tau:
                T_target_source = relative(poses[i], poses[j])
                overlaps[i, j] = pair_overlap(source, clouds[j], T_target_source, tau)
    return overlaps


def _most(labels: NDArray[np.uint8] | None) -> float:
    """Upper bound of an overlap ratio."""
    return 1.0 if labels is None else _share(labels != FAR)


def _share(mask: NDArray[np.bool_]) -> float:
    return float(mask.mean()) if len(mask) else 0.0


def _has_neighbour(points: NDArray[np.float64], tree: cKDTree, tau: float) -> NDArray[np.bool_]:
    if len(points) == 0 or tree.n == 0:
        return np.zeros(len(points), dtype=bool)
    # The bound of the query is exclusive; tau itself counts.
    bound = np.nextafter(tau, np.inf)
    distances, _ = tree.query(points, distance_upper_bound=bound)
    return np.asarray(np.isfinite(distances))


def _hull(points: NDArray[np.float64]) -> Delaunay | None:
    try:
        # Tetrahedra between the hull's vertices are searched far faster than its planes.
        return Delaunay(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):  # fewer than four points, or all in a plane
        return None


def _inside(points: NDArray[np.float64], hull: Delaunay | None) -> NDArray[np.bool_]:
    if hull is None:
        return np.zeros(len(points), dtype=bool)
    return np.asarray(hull.find_simplex(points, tol=_HULL_TOLERANCE) >= 0)
