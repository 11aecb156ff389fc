import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nss_ros.geometry import from_rotation, inverse, is_transform, rotation_angle, transform_points
from nss_ros.registration.gicp import gicp


def offset(degrees, metres):
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.3, -0.2, 0.93]))
    return from_rotation(turn, (metres, -metres / 2, metres / 3))


def test_a_start_that_is_somewhat_off_is_put_right(scans):
    truth = offset(30, 1.0)
    target = transform_points(truth, scans[1].points)
    start = offset(3, 0.1) @ truth
    found = gicp(scans[0].points, target, start, max_distance=0.1, iterations=40)
    error = inverse(truth) @ found
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert rotation_angle(error) < 0.005
    assert np.linalg.norm((inverse(truth) @ start)[:3, 3]) > 0.05


def test_without_iterations_nothing_moves(scans):
    start = offset(3, 0.1)
    found = gicp(scans[0].points, scans[1].points, start, max_distance=0.1, iterations=0)
    assert np.allclose(found, start, atol=1e-12)


@pytest.mark.parametrize("distance", [100.0, 1e5])
def test_clouds_that_do_not_touch_stay_where_they_are(distance, scans):
    start = offset(10, distance)
    found = gicp(scans[0].points, scans[1].points, start, max_distance=0.1, iterations=40)
    assert np.array_equal(found, start)


def test_few_points_give_a_transform():
    points = np.eye(3)
    found = gicp(points, points + 0.01, np.eye(4), max_distance=0.1, iterations=10)
    assert is_transform(found)
