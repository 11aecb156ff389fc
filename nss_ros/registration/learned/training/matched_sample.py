"""Points of a pair that lie on each other in truth, some of which a loss looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import Points
from nss_ros.geometry import Transform, transform_points
from nss_ros.registration.learned.training.example import correspondences

# Fewer correspondences, and a pair is not learned from.
_FEWEST = 64


@dataclass(frozen=True, slots=True)
class MatchedSample:
    """Correspondences of two clouds.

    Attributes:
        source: (k,) int64, points of the source that were drawn, each once.
        target: (k,) int64, a point of the target that lies on each of them.
        overlap: (n + m,) bool, which points of source and target lie on the other cloud.
        positions: (n + m, 3) float32, where all points are in truth, in the target's frame, voxels.
    """

    source: NDArray[np.int64]
    target: NDArray[np.int64]
    overlap: NDArray[np.bool_]
    positions: NDArray[np.float32]


def matched_sample(
    source: Points,
    target: Points,
    T_target_source: Transform,
    voxel_size: float,
    radius: float,
    count: int,
    random: np.random.Generator,
) -> MatchedSample | None:
    """Draw correspondences; None where there are too few.

    Args:
        source: (n, 3), metres.
        target: (m, 3), metres.
        T_target_source: true.
        voxel_size: metres.
        radius: longest distance of a correspondence, voxels.
        count: most that are drawn.
        random: draws them.
    """
    pairs = correspondences(source, target, T_target_source, radius * voxel_size)
    if len(pairs) < _FEWEST:
        return None
    overlap = np.zeros(len(source) + len(target), dtype=bool)
    overlap[pairs[:, 0]] = True
    overlap[len(source) + pairs[:, 1]] = True
    shuffled = random.permutation(len(pairs))
    _, first = np.unique(pairs[shuffled, 0], return_index=True)
    chosen = pairs[shuffled[random.permutation(first)[:count]]]
    positions = np.concatenate((transform_points(T_target_source, source), target))
    voxels = positions.astype(np.float32) / np.float32(voxel_size)
    return MatchedSample(chosen[:, 0], chosen[:, 1], overlap, voxels)
