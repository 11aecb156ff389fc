"""Drift of stage scans, made on purpose: what the refinement of ground truth has to undo.

Simulated poses are exact. With drift they are like those of real stage scans, which are chained
from spot to spot and then aligned as a whole: right on average, and off by centimetres here and
there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.distance import cdist

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, from_yaw

_JITTER = 1e-9


def drifted_poses(
    poses: Mapping[FragmentId, Transform],
    seed: int,
    sigma: float = 0.03,
    yaw_sigma: float = 0.1,
    length: float = 25.0,
) -> dict[FragmentId, Transform]:
    """Poses displaced by a smooth random field, another one for every stage.

    Args:
        poses: true `T_map_fragment`.
        seed: of the field.
        sigma: displacement along each axis, metres, one standard deviation.
        yaw_sigma: turn about the upright through the spot, degrees, one standard deviation.
        length: distance over which the displacement changes (of a Gaussian covariance), metres.
    """
    stages: dict[tuple[str, int], list[FragmentId]] = {}
    for fragment in sorted(poses):
        stages.setdefault((fragment.area, fragment.stage), []).append(fragment)
    drifted = {}
    for number, members in enumerate(stages.values()):
        rng = np.random.default_rng((seed, number))
        spots = np.array([poses[member][:2, 3] for member in members])
        covariance = np.exp(-cdist(spots, spots, "sqeuclidean") / (2 * length**2))
        factor = np.linalg.cholesky(covariance + _JITTER * np.eye(len(spots)))
        field = factor @ rng.normal(size=(len(spots), 4))
        for member, (x, y, z, yaw) in zip(members, field, strict=True):
            turned = np.array(poses[member])
            turned[:3, :3] = (
                from_yaw(np.radians(yaw_sigma) * yaw, (0, 0, 0))[:3, :3] @ (poses[member][:3, :3])
            )
            turned[:3, 3] += sigma * np.array((x, y, z))
            drifted[member] = turned
    return {fragment: drifted[fragment] for fragment in poses}
