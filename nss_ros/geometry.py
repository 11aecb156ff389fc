"""Rigid transforms as 4x4 float64 matrices.

A transform `T_target_source` maps source coordinates to target coordinates. Covariances and
information matrices of a transform are 6x6 in ROS order (x, y, z, rx, ry, rz), metres and
radians, of a perturbation applied in the target frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from nss_ros.errors import InputError

Transform = NDArray[np.float64]
Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

ROTATION_TOLERANCE = 1e-3


def is_transform(matrix: ArrayLike, tolerance: float = ROTATION_TOLERANCE) -> bool:
    """Whether a matrix is a finite rigid transform (proper rotation, last row 0 0 0 1)."""
    candidate = np.asarray(matrix, dtype=np.float64)
    if candidate.shape != (4, 4) or not np.isfinite(candidate).all():
        return False
    rotation = candidate[:3, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=tolerance)
        and np.linalg.det(rotation) > 0
        and np.allclose(candidate[3], (0, 0, 0, 1), atol=tolerance)
    )


def as_transform(matrix: ArrayLike, name: str = "transform") -> Transform:
    """The matrix as a transform with an exactly orthonormal rotation.

    Args:
        matrix: anything of shape (4, 4).
        name: what the matrix is, for the error message.

    Raises:
        InputError: it is not a finite rigid transform.
    """
    if not is_transform(matrix):
        raise InputError(
            f"{name} is not a rigid transform: expected a finite 4x4 matrix of rotation, "
            "translation and last row 0 0 0 1."
        )
    transform = np.array(matrix, dtype=np.float64)
    left, _, right = np.linalg.svd(transform[:3, :3])
    transform[:3, :3] = left @ right
    transform[3] = (0, 0, 0, 1)
    return transform


def inverse(transform: Transform) -> Transform:
    """The inverse, `T_source_target` of `T_target_source`."""
    result = np.eye(4)
    result[:3, :3] = transform[:3, :3].T
    result[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return result


def relative(T_map_source: Transform, T_map_target: Transform) -> Transform:
    """`T_target_source` of two poses in one map frame."""
    return inverse(T_map_target) @ T_map_source


def transform_points(transform: Transform, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points (n, 3) moved by a transform, float64."""
    return np.asarray(points @ transform[:3, :3].T + transform[:3, 3], dtype=np.float64)


def spherical(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Distance, azimuth and elevation of points (..., 3) from the origin, each (...).

    Azimuth in 0..2 pi from the negative x axis, elevation in 0..pi from straight below, radians.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    distance = np.sqrt(x * x + y * y + z * z)
    elevation = np.arcsin(np.clip(z / np.maximum(distance, 1e-9), -1, 1)) + np.pi / 2
    return distance, np.arctan2(y, x) + np.pi, elevation


def from_rotation(rotation: Rotation, translation: ArrayLike) -> Transform:
    """A transform from a scipy rotation and a translation in metres."""
    transform = np.eye(4)
    transform[:3, :3] = rotation.as_matrix()
    transform[:3, 3] = np.asarray(translation, dtype=np.float64)
    return transform


def from_quaternion(xyzw: ArrayLike, translation: ArrayLike) -> Transform:
    """A transform from a quaternion (x, y, z, w), of any non-zero length, and metres.

    Raises:
        InputError: the quaternion is not finite, or has no length.
    """
    # In plain numbers: logs hold many poses, and a scipy rotation takes 20 times as long.
    x, y, z, w = np.asarray(xyzw, dtype=np.float64).tolist()
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < 1e-9:
        raise InputError("An orientation needs a finite quaternion of non-zero length.")
    x, y, z, w = x / length, y / length, z / length, w / length
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, yz = x * y, x * z, y * z
    xw, yw, zw = x * w, y * w, z * w
    tx, ty, tz = np.asarray(translation, dtype=np.float64).tolist()
    return np.array(
        (
            (xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw), tx),
            (2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw), ty),
            (2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww, tz),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def to_quaternion(transform: Transform) -> Vector:
    """The unit quaternion (x, y, z, w), w >= 0, of a transform's rotation."""
    quaternion = Rotation.from_matrix(transform[:3, :3]).as_quat(canonical=True)
    return np.asarray(quaternion, dtype=np.float64)


def from_up(up: ArrayLike) -> Transform:
    """The smallest turn that takes the z axis to the direction of a vector (3,), not downwards."""
    x, y, z = np.asarray(up, dtype=np.float64)
    axis = np.array((-y, x, 0.0))
    sine = float(np.linalg.norm(axis))
    if sine == 0:
        return np.eye(4)
    return from_rotation(Rotation.from_rotvec(axis / sine * np.arctan2(sine, z)), np.zeros(3))


def from_yaw(yaw: float, translation: ArrayLike) -> Transform:
    """A transform that turns about z by `yaw` radians."""
    return from_rotation(Rotation.from_euler("z", yaw), translation)


def rotation_angle(transform: Transform) -> float:
    """Angle of a transform's rotation, radians in [0, pi]."""
    return float(Rotation.from_matrix(transform[:3, :3]).magnitude())


def tilt_angle(transform: Transform) -> float:
    """Angle between the z axes of source and target, radians in [0, pi]."""
    return float(np.arccos(np.clip(transform[2, 2], -1.0, 1.0)))


def exponential(twist: ArrayLike) -> Transform:
    """SE(3) exponential of a twist (x, y, z, rx, ry, rz)."""
    rho, phi = np.split(np.asarray(twist, dtype=np.float64), 2)
    return from_rotation(Rotation.from_rotvec(phi), _left_jacobian(phi) @ rho)


def logarithm(transform: Transform) -> Vector:
    """SE(3) logarithm, a twist (x, y, z, rx, ry, rz); inverse of `exponential`."""
    phi = Rotation.from_matrix(transform[:3, :3]).as_rotvec()
    rho = np.linalg.solve(_left_jacobian(phi), transform[:3, 3])
    return np.concatenate((rho, phi))


def adjoint(transform: Transform) -> Matrix:
    """6x6 adjoint: `T exp(x) inv(T) == exp(adjoint(T) x)`, order (x, y, z, rx, ry, rz)."""
    rotation = transform[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[:3, 3:] = skew(transform[:3, 3]) @ rotation
    return result


def skew(vector: ArrayLike) -> Matrix:
    """The 3x3 matrix of a cross product."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _left_jacobian(phi: Vector) -> Matrix:
    angle = float(np.linalg.norm(phi))
    cross = skew(phi)
    if angle < 1e-6:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    a = (1 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)
