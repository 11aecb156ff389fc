"""Uncertainty of poses from the information of the relative transforms between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Matrix, adjoint, inverse
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.spanning_tree import Poses

# Keeps directions that nothing observes finite: a standard deviation of 100 m.
_LEAST_INFORMATION = 1e-4


def pose_covariances(
    members: Sequence[FragmentId], measurements: Sequence[Measurement], poses: Poses
) -> dict[FragmentId, Matrix]:
    """Marginal covariance of each pose relative to the first member, which is certain.

    With poses perturbed in the map frame, `P = exp(x) P`, the error of a relative transform is
    `adjoint(inv(P_target)) (x_source - x_target)` to first order, so the Hessian is a Laplacian
    of 6x6 blocks.

    Args:
        members: one connected component.
        measurements: within it.
        poses: `T_map_fragment`.

    Returns:
        (6, 6) each, order x y z rx ry rz (m, rad), map frame.
    """
    index = {id_: i - 1 for i, id_ in enumerate(members)}
    size = len(members) - 1
    blocks: dict[tuple[int, int], Matrix] = {
        (i, i): np.eye(6) * _LEAST_INFORMATION for i in range(size)
    }
    for m in measurements:
        moved = adjoint(inverse(poses[m.pair.target]))
        information = moved.T @ m.information @ moved
        ends = (index[m.pair.source], index[m.pair.target])
        for row in ends:
            for column in ends:
                if row >= 0 and column >= 0:
                    sign = 1.0 if row == column else -1.0
                    block = blocks.setdefault((row, column), np.zeros((6, 6)))
                    block += sign * information
    factor = splu(_sparse(blocks, size))
    covariances = {members[0]: np.zeros((6, 6))}
    for id_ in members[1:]:
        start = 6 * index[id_]
        unit = np.zeros((6 * size, 6))
        unit[start : start + 6] = np.eye(6)
        block = factor.solve(unit)[start : start + 6]
        covariances[id_] = (block + block.T) / 2
    return covariances


def _sparse(blocks: dict[tuple[int, int], Matrix], size: int) -> csc_array:
    order = sorted(blocks)
    columns = np.array([column for _, column in order])
    counts = np.bincount([row for row, _ in order], minlength=size)
    pointers = np.concatenate(([0], np.cumsum(counts)))
    data = np.array([blocks[key] for key in order])
    return csc_array(bsr_array((data, columns, pointers), shape=(6 * size, 6 * size)))
