"""Point-to-plane ICP from coarse to fine (Chen and Medioni 1992), reproducible to the bit.

Open3D's ICP sums in parallel, in an order that differs from run to run; this one does not, and on
fragments of this size it is as fast. Both the registration of pairs and the refinement of ground
truth use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.geometry import Matrix, Transform, as_transform, exponential

# Each level halves the correspondence distance down to the configured one.
_LEVELS = (2.0, 1.0)
_CONVERGED_TRANSLATION = 1e-4
_CONVERGED_ROTATION = 1e-5
# Residuals are correlated over patches: one object, one drift of the sensor, one bad normal. Each
# patch of this size counts as one observation.
_CORRELATION_LENGTH = 0.5
# No estimate is taken to be better than the sensor's and the voxels' systematic errors.
_LEAST_DEVIATION = 0.01
_NORMAL_COSINE = 0.5
# A direction along which the surfaces can slide is unknown by metres, not infinitely.
_LEAST_INFORMATION = 1e-2

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Surface:
    """Points with normals and their search tree, made once and used for many alignments.

    Attributes:
        points: (n, 3) float64, metres.
        normals: (n, 3) float64, unit.
        tree: of `points`.
        oriented: normals point to the side from which the surface was seen; otherwise their
            sign means nothing.
    """

    points: Array
    normals: Array
    tree: Any
    oriented: bool = True

    @classmethod
    def of(
        cls, points: NDArray[np.floating], normals: NDArray[np.floating], oriented: bool = True
    ) -> Surface:
        """A surface of points (n, 3) and unit normals (n, 3)."""
        array = np.asarray(points, dtype=np.float64)
        # Of points that are spread evenly a tree by halves of space is as deep as a balanced one,
        # and made a third faster.
        tree = cKDTree(array, balanced_tree=False)
        return cls(array, np.asarray(normals, dtype=np.float64), tree, oriented)

    @classmethod
    def sample(
        cls, points: NDArray[np.floating], normals: NDArray[np.floating], count: int
    ) -> Surface:
        """A surface of at most `count` of points (n, 3) with normals (n, 3), evenly taken."""
        chosen = np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)
        return cls.of(points[chosen], normals[chosen])


@dataclass(frozen=True, slots=True)
class Refined:
    """Result of ICP.

    Attributes:
        T_target_source: (4, 4).
        information: (6, 6) inverse covariance, order x y z rx ry rz, target frame; see `refine`.
        correspondences: of the last iteration.
        rmse: root mean square point-to-plane distance of them, by their weights, metres.
        converged: the last update was negligible.
    """

    T_target_source: Transform
    information: Matrix
    correspondences: int
    rmse: float
    converged: bool

    @property
    def covariance(self) -> Matrix:
        """(6, 6), positive definite: unknown directions of the information are bounded."""
        values, vectors = np.linalg.eigh(self.information)
        known = np.maximum(values, _LEAST_INFORMATION)
        covariance = np.einsum("ij,j,kj->ik", vectors, 1 / known, vectors)
        return np.asarray((covariance + covariance.T) / 2)


def moved_by(transform: Transform, points: Array) -> Array:
    """Points (n, 3) moved by a transform, rounded the same whatever BLAS library is installed."""
    return np.asarray(np.einsum("nj,ij->ni", points, transform[:3, :3]) + transform[:3, 3])


def facing(
    source: Surface,
    target: Surface,
    T_target_source: Transform,
    distance: float,
    least_cosine: float = _NORMAL_COSINE,
) -> tuple[Array, Array, Array]:
    """Points of the source that lie beside a surface of the target which faces the same way.

    Args:
        source: surface that is moved.
        target: surface that stays.
        T_target_source: by which.
        distance: from the nearest point of the target at most, metres.
        least_cosine: of the angle between the normals of both.

    Returns:
        The points (n, 3) where they are then, the normals (n, 3) of the target there, and how far
        they are in front of it (n,), metres.
    """
    moved = moved_by(T_target_source, source.points)
    _, nearest = target.tree.query(moved, distance_upper_bound=distance)
    found = np.flatnonzero(nearest < len(target.points))
    moved, matched = moved[found], nearest[found]
    normals = target.normals[matched]
    turned = np.einsum("nj,ij->ni", source.normals[found], T_target_source[:3, :3])
    cosines = np.einsum("ij,ij->i", turned, normals)
    if not (source.oriented and target.oriented):
        cosines = np.abs(cosines)
    chosen = cosines > least_cosine
    moved, matched, normals = moved[chosen], matched[chosen], normals[chosen]
    return moved, normals, np.einsum("ij,ij->i", moved - target.points[matched], normals)


def refine(
    source: Surface,
    target: Surface,
    T_target_source: Transform,
    max_distance: float,
    iterations: int,
    levels: tuple[float, ...] = _LEVELS,
    kernel: float | None = None,
    damping: float = 0.0,
) -> Refined:
    """Refine a transform by point-to-plane ICP.

    The information matrix is the Hessian of the last iteration over the residual variance, scaled
    by (independent patches / correspondences): neighbouring residuals are correlated, so the
    source's occupied cells of 0.5 m are counted as the independent observations, not its points.

    Args:
        source: surface that is moved.
        target: surface that stays.
        T_target_source: start.
        max_distance: longest correspondence of the last level, metres.
        iterations: most iterations per level.
        levels: correspondence distance of each level, as multiples of `max_distance`.
        kernel: distance from the plane at which a correspondence counts a quarter (Geman and
            McClure 1987), metres, times the level; None: all count alike. With it, what changed
            between two stages does not pull.
        damping: information added to every direction of an update, as a share of the
            correspondences: where the surfaces can slide, noise does not carry the source away.
    """
    transform = T_target_source
    converged = False
    for level in levels:
        for _ in range(iterations):
            scale = None if kernel is None else level * kernel
            system, _ = _linearize(source, target, transform, level * max_distance, scale)
            hessian = system.hessian + damping * system.count * np.eye(6)
            update = np.linalg.lstsq(hessian, -system.gradient, rcond=1e-9)[0]
            transform = as_transform(exponential(update) @ transform)
            converged = bool(
                np.linalg.norm(update[:3]) < _CONVERGED_TRANSLATION
                and np.linalg.norm(update[3:]) < _CONVERGED_ROTATION
            )
            if converged or system.count < 6:
                break
    scale = None if kernel is None else levels[-1] * kernel
    system, moved = _linearize(source, target, transform, levels[-1] * max_distance, scale)
    information = system.information(_patches(moved))
    return Refined(transform, information, system.count, system.rmse, converged)


@dataclass(frozen=True, slots=True)
class _System:
    """Gauss-Newton system of one iteration."""

    hessian: Matrix
    gradient: Array
    count: int
    rmse: float

    def information(self, observations: int) -> Matrix:
        if self.count == 0:
            return np.zeros((6, 6))
        variance = max(self.rmse, _LEAST_DEVIATION) ** 2
        return np.asarray(self.hessian / variance * (observations / self.count))


def _linearize(
    source: Surface,
    target: Surface,
    transform: Transform,
    distance: float,
    kernel: float | None,
) -> tuple[_System, Array]:
    moved, normals, residuals = facing(source, target, transform, distance)
    jacobian = np.hstack((normals, np.cross(moved, normals)))
    if kernel is None:
        weighted, mean_square = jacobian, residuals**2
    else:
        weights = (kernel**2 / (kernel**2 + residuals**2)) ** 2
        weighted = jacobian * weights[:, None]
        mean_square = weights * residuals**2 * (len(weights) / max(float(weights.sum()), 1e-12))
    system = _System(
        hessian=np.einsum("ni,nj->ij", weighted, jacobian),
        gradient=np.einsum("ni,n->i", weighted, residuals),
        count=len(residuals),
        rmse=float(np.sqrt(np.mean(mean_square))) if len(residuals) else 0.0,
    )
    return system, moved


def _patches(points: Array) -> int:
    if len(points) == 0:
        return 0
    cells = np.floor(points / _CORRELATION_LENGTH).astype(np.int64)
    return len(np.unique(cells, axis=0))
