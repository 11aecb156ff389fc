import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from nss_ros.errors import InputError
from nss_ros.geometry import (
    adjoint,
    as_transform,
    exponential,
    from_quaternion,
    from_up,
    from_yaw,
    inverse,
    is_transform,
    logarithm,
    relative,
    rotation_angle,
    spherical,
    tilt_angle,
    to_quaternion,
    transform_points,
)

numbers = st.floats(-3, 3, allow_subnormal=False)
twists = arrays(np.float64, 6, elements=numbers)
transforms = twists.map(exponential)


@given(transforms)
def test_exponential_gives_rigid_transforms(transform):
    assert is_transform(transform, 1e-9)


@given(transforms)
def test_inverse_undoes(transform):
    np.testing.assert_allclose(inverse(transform) @ transform, np.eye(4), atol=1e-9)


@given(arrays(np.float64, 6, elements=st.floats(-1.7, 1.7, allow_subnormal=False)))
def test_logarithm_undoes_exponential(twist):
    np.testing.assert_allclose(logarithm(exponential(twist)), twist, atol=1e-7)


@given(transforms, arrays(np.float64, 6, elements=st.floats(-0.5, 0.5)))
def test_adjoint_moves_a_perturbation_to_the_target_frame(transform, twist):
    left = transform @ exponential(twist) @ inverse(transform)
    np.testing.assert_allclose(left, exponential(adjoint(transform) @ twist), atol=1e-9)


@given(arrays(np.float64, 4, elements=numbers), arrays(np.float64, 3, elements=numbers))
def test_quaternions_of_any_length_are_those_of_scipy(xyzw, translation):
    if np.linalg.norm(xyzw) < 1e-9:
        with pytest.raises(InputError, match="non-zero length"):
            from_quaternion(xyzw, translation)
        return
    transform = from_quaternion(xyzw, translation)
    rotation = Rotation.from_quat(xyzw).as_matrix()
    np.testing.assert_allclose(transform[:3, :3], rotation, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(transform[:3, 3], translation)
    np.testing.assert_array_equal(transform[3], (0, 0, 0, 1))


@given(transforms)
def test_quaternion_round_trip_is_exact_enough_for_scores(transform):
    again = from_quaternion(to_quaternion(transform), transform[:3, 3])
    np.testing.assert_allclose(again, transform, atol=1e-12)


@given(transforms, transforms, transforms)
def test_relative_does_not_depend_on_the_map_frame(source, target, frame):
    moved = relative(frame @ source, frame @ target)
    np.testing.assert_allclose(moved, relative(source, target), atol=1e-7)


@given(transforms, transforms, arrays(np.float32, (5, 3), elements=st.floats(-9, 9, width=32)))
def test_points_move_as_transforms_compose(first, second, points):
    stepwise = transform_points(second, transform_points(first, points))
    np.testing.assert_allclose(stepwise, transform_points(second @ first, points), atol=1e-7)


@given(st.floats(-3.1, 3.1))
def test_yaw_turns_without_tilting(yaw):
    transform = from_yaw(yaw, (1, 2, 3))
    assert rotation_angle(transform) == pytest.approx(abs(yaw), abs=1e-7)
    assert tilt_angle(transform) == pytest.approx(0, abs=1e-7)


def test_tilt_is_the_angle_between_the_vertical_axes():
    assert tilt_angle(exponential([0, 0, 0, 0.3, 0, 0])) == pytest.approx(0.3)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((4, 4)),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1, -1, 1]),
        np.diag([2.0, 2, 2, 1]),
        np.eye(3),
    ],
)
def test_what_is_not_rigid_is_refused_by_name(matrix):
    with pytest.raises(InputError, match="node 3 is not a rigid transform"):
        as_transform(matrix, "node 3")


def test_float32_noise_in_a_rotation_is_mended():
    noisy = exponential([1, 2, 3, 0.1, 0.2, 0.3]).astype(np.float32)
    assert is_transform(as_transform(noisy), 1e-12)


def test_a_quaternion_without_length_is_refused():
    with pytest.raises(InputError, match="quaternion"):
        from_quaternion((0, 0, 0, 0), (0, 0, 0))


@given(arrays(np.float64, (4, 3), elements=numbers))
def test_spherical_coordinates_give_the_points_back(points):
    distance, azimuth, elevation = spherical(points)
    flat = distance * np.sin(elevation)
    back = np.stack(
        (-flat * np.cos(azimuth), -flat * np.sin(azimuth), -distance * np.cos(elevation)), axis=-1
    )
    np.testing.assert_allclose(back, points, atol=1e-6)


@given(st.tuples(numbers, numbers, st.floats(0.01, 3)))
def test_the_z_axis_is_turned_to_a_direction_by_no_more_than_it_takes(up):
    transform = from_up(up)
    assert is_transform(transform)
    direction = np.array(up) / np.linalg.norm(up)
    assert np.allclose(transform[:3, 2], direction, atol=1e-9)
    assert np.isclose(rotation_angle(transform), tilt_angle(transform), atol=1e-6)
    assert not transform[:3, 3].any()
