"""How much two fragments overlap, and how much of that has changed.

Both figures are of the NSS paper's pairwise dataset (Sun et al. 2023, arXiv 2311.09346) with
tau = 0.2 m. The text of the paper's formulas was not available when this was written; what is
certain is that each edge of the challenge's graphs carries one `overlap` and one
`temporal_change`, both in [0, 1], with the source before the target in the order of the nodes,
and that the temporal change ratio is taken within convex hulls. The formulas below are our
reading of that:

- overlap ratio: the share of source points that have a target point within tau after
  ground-truth alignment; it is not symmetric.
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

from nss_ros.geometry import Transform, inverse, relative, transform_points

_HULL_TOLERANCE = 1e-9  # of barycentric coordinates


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points in their own frame with what every pair of them needs.

    Attributes:
        points: (n, 3) metres.
        tree: of the points.
        hull: tetrahedra that fill the convex hull; None for flat or tiny clouds.
        radius: largest distance of a point from the origin of its frame, metres.
    """

    points: NDArray[np.floating]
    tree: cKDTree = field(init=False)
    hull: Delaunay | None = field(init=False)
    radius: float = field(init=False)

    def __post_init__(self) -> None:
        lengths = np.linalg.norm(self.points, axis=1)
        object.__setattr__(self, "tree", cKDTree(self.points))
        object.__setattr__(self, "hull", _hull(self.points))
        object.__setattr__(self, "radius", float(lengths.max(initial=0.0)))


@dataclass(frozen=True, slots=True)
class PairOverlap:
    """Overlap ratio and temporal change ratio of a pair; see the module."""

    overlap_ratio: float
    temporal_change: float


def pair_overlap(
    source: Cloud, target: Cloud, T_target_source: Transform, tau: float = 0.2
) -> PairOverlap:
    """Both ratios of one pair.

    Args:
        source: the source's points.
        target: the target's points.
        T_target_source: ground truth.
        tau: metres.

    Returns:
        Overlap ratio (0 for an empty source) and temporal change ratio (NaN where no point
        lies in the hull of the other).
    """
    source_in_target = transform_points(T_target_source, source.points)
    target_in_source = transform_points(inverse(T_target_source), target.points)
    source_met = _has_neighbour(source_in_target, target.tree, tau)
    target_met = _has_neighbour(target_in_source, source.tree, tau)
    shared = np.concatenate(
        (
            source_met[_inside(source_in_target, target.hull)],
            target_met[_inside(target_in_source, source.hull)],
        )
    )
    return PairOverlap(
        overlap_ratio=float(source_met.mean()) if len(source_met) else 0.0,
        temporal_change=float(1 - shared.mean()) if len(shared) else float("nan"),
    )


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


def _has_neighbour(points: NDArray[np.float64], tree: cKDTree, tau: float) -> NDArray[np.bool_]:
    if len(points) == 0 or tree.n == 0:
        return np.zeros(len(points), dtype=bool)
    # The bound of the query is exclusive; tau itself counts.
    bound = np.nextafter(tau, np.inf)
    distances, _ = tree.query(points, distance_upper_bound=bound)
    return np.asarray(np.isfinite(distances))


def _hull(points: NDArray[np.floating]) -> Delaunay | None:
    try:
        # Tetrahedra between the hull's vertices are searched far faster than its planes.
        return Delaunay(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):  # fewer than four points, or all in a plane
        return None


def _inside(points: NDArray[np.float64], hull: Delaunay | None) -> NDArray[np.bool_]:
    if hull is None:
        return np.zeros(len(points), dtype=bool)
    return np.asarray(hull.find_simplex(points, tol=_HULL_TOLERANCE) >= 0)
