"""Generalized ICP (Segal, Haehnel and Thrun, RSS 2009) by small_gicp (Koide 2024)."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import MethodError
from nss_ros.geometry import Transform, as_transform, is_transform

# Each level reaches less far; the start is as coarse as the voxels of a global method.
_LEVELS = (3.0, 1.0)
_NEIGHBOURS = 20


def gicp(
    source: NDArray[np.floating],
    target: NDArray[np.floating],
    T_target_source: Transform,
    max_distance: float,
    iterations: int,
) -> Transform:
    """Refine a transform by distribution-to-distribution ICP; the start where that fails.

    Args:
        source: (n, 3) points that are moved, metres.
        target: (m, 3) points that stay, metres.
        T_target_source: start.
        max_distance: longest correspondence of the last level, metres.
        iterations: most iterations per level.

    Raises:
        MethodError: small_gicp is not installed.
    """
    library = load_small_gicp()
    moving, _ = _with_covariances(source)
    still, tree = _with_covariances(target)
    transform = T_target_source
    for level in _LEVELS:
        result = library.align(
            still,
            moving,
            tree,
            transform,
            registration_type="GICP",
            max_correspondence_distance=level * max_distance,
            max_iterations=iterations,
            num_threads=1,
        )
        if result.num_inliers == 0 or not is_transform(result.T_target_source):
            return transform
        transform = as_transform(result.T_target_source)
    return transform


@cache
def load_small_gicp() -> Any:
    """The module small_gicp.

    Raises:
        MethodError: it is not installed.
    """
    try:
        import small_gicp
    except ImportError as error:
        raise MethodError(
            "Refinement by GICP needs the package small-gicp: pip install small-gicp."
        ) from error
    return small_gicp


def _with_covariances(points: NDArray[np.floating]) -> tuple[Any, Any]:
    """A point cloud of small_gicp with its search tree."""
    library = load_small_gicp()
    cloud = library.PointCloud(points.astype(np.float64))
    tree = library.KdTree(cloud)
    library.estimate_covariances(cloud, tree, num_neighbors=_NEIGHBOURS)
    return cloud, tree
