"""The measures of registration, each defined once.

Notation: `T` is an estimate, `T*` the ground truth, both `T_target_source` or both poses;
R and t are rotation and translation of a transform. Source: Sun et al., "Nothing Stands Still:
A spatiotemporal benchmark on 3D point cloud registration", section on evaluation metrics, and
the evaluator of its challenge where the two differ.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.geometry import Transform, transform_points

MAX_RRE = 10.0
"""Largest RRE of a successful registration, degrees."""
MAX_RTE = 0.2
"""Largest RTE of a successful registration in the paper, metres."""
MAX_RTE_CHALLENGE = 0.1
"""Largest RTE of a successful registration in the challenge, metres."""
CORRESPONDENCE_DISTANCE = 0.1
"""Points closer than this under the ground truth correspond, metres."""

Floats = NDArray[np.float64]


def rotation_error(ground_truth: Transform, estimate: Transform) -> Floats:
    """Relative rotation error (RRE), degrees in [0, 180].

    RRE = arccos(clip((tr(R*^T R) - 1) / 2, -1, 1)).

    Args:
        ground_truth: T*, (..., 4, 4).
        estimate: T, (..., 4, 4).

    Returns:
        One error per transform, (...).
    """
    difference = np.swapaxes(ground_truth[..., :3, :3], -1, -2) @ estimate[..., :3, :3]
    cosine = (np.trace(difference, axis1=-2, axis2=-1) - 1) / 2
    return np.asarray(180.0 * np.arccos(np.clip(cosine, -1, 1)) / np.pi)


def translation_error(ground_truth: Transform, estimate: Transform) -> Floats:
    """Relative translation error (RTE), metres.

    RTE = |t* - t|.

    Args:
        ground_truth: T*, (..., 4, 4).
        estimate: T, (..., 4, 4).

    Returns:
        One error per transform, (...).
    """
    difference = ground_truth[..., :3, 3] - estimate[..., :3, 3]
    # A dot product, as the official evaluator's norm: equal to the last bit at the threshold.
    return np.asarray(np.sqrt((difference[..., None, :] @ difference[..., None])[..., 0, 0]))


def successes(
    rre: Floats, rte: Floats, max_rre: float = MAX_RRE, max_rte: float = MAX_RTE
) -> NDArray[np.bool_]:
    """Whether each registration succeeded: RRE <= max_rre and RTE <= max_rte.

    NaN, meaning no answer, is not a success.
    """
    return np.asarray((rre <= max_rre) & (rte <= max_rte))


def recall(success: NDArray[np.bool_]) -> float:
    """Registration recall: successes in percent of what was to be registered; NaN of nothing."""
    return float(np.count_nonzero(success) / len(success) * 100) if len(success) else float("nan")


def rmse(points: Floats, others: Floats) -> float:
    """Root mean square distance of paired points, metres: sqrt(mean |p_i - q_i|^2)."""
    return float(np.sqrt(np.mean(np.square(np.linalg.norm(points - others, axis=1)))))


def correspondences(
    source: Floats, target: cKDTree, T_target_source: Transform
) -> NDArray[np.intp]:
    """Indices (source, target) of points that coincide under the ground truth, (n, 2).

    The nearest target point of every source point moved by T*, where it is closer than 0.1 m.

    Args:
        source: (n, 3), metres, source frame.
        target: search tree of the target's points.
        T_target_source: the ground truth T*.
    """
    # The bound, a little larger so that only the comparison below decides, makes this fast.
    distances, indices = target.query(
        transform_points(T_target_source, source),
        distance_upper_bound=CORRESPONDENCE_DISTANCE * (1 + 1e-6),
    )
    close = distances < CORRESPONDENCE_DISTANCE
    return np.column_stack((np.flatnonzero(close), indices[close]))


def pairwise_rmse(
    source: Floats, target: Floats, pairs: NDArray[np.intp], estimate: Transform
) -> float:
    """RMSE of one pair, metres, over the correspondences (i, j) of the ground truth.

    RMSE = sqrt(mean |T s_i - t_j|^2); infinity without correspondences, as the challenge has it.

    Args:
        source: (n, 3), metres, source frame.
        target: (m, 3), metres, target frame.
        pairs: (k, 2) indices, of `correspondences`.
        estimate: T, (4, 4) `T_target_source`.
    """
    if len(pairs) == 0:
        return float("inf")
    return rmse(transform_points(estimate, source)[pairs[:, 0]], target[pairs[:, 1]])


def squared_displacement(points: Floats, ground_truth: Transform, estimate: Transform) -> float:
    """Sum over the points of |T* p - T p|^2, square metres.

    The global RMSE of a map is sqrt(sum over fragments / number of points), with T* and T the
    poses of each fragment in the frame of the same anchor fragment a:
    T* = inv(A*) T*_map_fragment and T = inv(A) T_map_fragment. There is no other alignment.
    """
    moved = transform_points(ground_truth, points) - transform_points(estimate, points)
    return float(np.sum(np.square(np.linalg.norm(moved, axis=1))))


def f1_score(truth: NDArray[np.bool_], prediction: NDArray[np.bool_]) -> float:
    """F1 of a binary prediction, percent: 2 TP / (2 TP + FP + FN); 0 without any positive."""
    denominator = np.count_nonzero(truth) + np.count_nonzero(prediction)
    hits = np.count_nonzero(truth & prediction)
    return float(2 * hits / denominator * 100) if denominator else 0.0
