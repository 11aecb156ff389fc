"""Fast global registration over matched keypoints (Zhou, Park, Koltun, ECCV 2016)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform, is_transform
from nss_ros.registration.ransac import Matches, rigid_samples

_TUPLES_DRAWN = 100_000
_TUPLES_KEPT = 1000


def fast_global_registration(
    matches: Matches, distance: float, iterations: int, seed: int
) -> Transform | None:
    """The transform that graduated non-convexity finds, or None when no tuple of matches is rigid.

    Tuples of three matches are drawn and tested here, so that a seed gives one answer; Open3D
    optimises over them.

    Args:
        matches: matched keypoints.
        distance: a match agrees when it ends closer than this, metres.
        iterations: of the optimisation.
        seed: of the tuples.
    """
    if len(matches) < 3:
        return None
    random = np.random.default_rng(seed)
    samples = random.integers(0, len(matches), size=(_TUPLES_DRAWN, 3))
    tuples = rigid_samples(matches, samples, distance, level=False)[:_TUPLES_KEPT]
    if len(tuples) == 0:
        return None
    transform = _optimize(matches, tuples.reshape(-1), distance, iterations)
    return transform if is_transform(transform) else None


def _optimize(
    matches: Matches, chosen: NDArray[np.int64], distance: float, iterations: int
) -> Transform:
    import open3d as o3d

    registration = o3d.pipelines.registration
    source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(matches.source))
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(matches.target))
    pairs = o3d.utility.Vector2iVector(np.stack((chosen, chosen), axis=1).astype(np.int32))
    option = registration.FastGlobalRegistrationOption(
        maximum_correspondence_distance=distance,
        iteration_number=iterations,
        decrease_mu=True,
        tuple_test=False,
    )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        result = registration.registration_fgr_based_on_correspondence(
            source, target, pairs, option
        )
    return np.array(result.transformation, dtype=np.float64)
