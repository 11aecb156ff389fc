"""From the answer to a pair to the measurement that a synchronizer takes."""

from __future__ import annotations

import numpy as np

from nss_ros.errors import InputError
from nss_ros.geometry import Matrix
from nss_ros.multiway.pose_graph import Alternative, Measurement
from nss_ros.registration.relative_transform import RelativeTransform

# Stands in for a covariance that a method did not compute: 0.05 m and 1 deg.
_UNKNOWN = np.diag([0.05**2] * 3 + [np.deg2rad(1.0) ** 2] * 3)
# No estimate counts as better than 1 cm and 0.1 deg, whatever it says of itself: points of a real
# scan err together, by the scanner's own bends, of which no residual tells. With a tenth of this,
# shifts along a corridor gave way by decimetres to turns that were taken for exact.
_FLOOR = np.diag([0.01**2] * 3 + [np.deg2rad(0.1) ** 2] * 3)


def measurement(result: RelativeTransform, level: bool) -> Measurement:
    """The measurement of an answer that holds an estimate.

    Args:
        result: the answer.
        level: both fragments are gravity aligned.

    Raises:
        InputError: the answer is a failure.
    """
    if not result.ok:
        raise InputError(f"Pair {result.pair} has no estimate: {result.message}")
    return Measurement(
        result.pair,
        result.T_target_source,
        information(result.covariance),
        confidence=result.confidence,
        inliers=result.inliers,
        level=level,
        alternatives=tuple(
            Alternative(each.T_target_source, information(each.covariance), each.probability)
            for each in result.alternatives
        ),
    )


def information(covariance: Matrix) -> Matrix:
    """Inverse of a covariance (6, 6); of a standard one where it is zero or not valid."""
    symmetric = (covariance + covariance.T) / 2
    valid = np.isfinite(symmetric).all() and np.linalg.eigvalsh(symmetric)[0] > 0
    return np.asarray(np.linalg.inv((symmetric if valid else _UNKNOWN) + _FLOOR))
