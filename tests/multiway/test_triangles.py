import numpy as np

from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.spanning_tree import components, spanning_tree_poses
from nss_ros.multiway.triangles import triangle_support

IDS = [FragmentId("1", 1, spot) for spot in range(5)]
POSES = {id_: from_yaw(0.7 * i, (2.0 * i, i % 2, 0.1 * i)) for i, id_ in enumerate(IDS)}
WRONG = from_yaw(1.0, (1, 1, 0))


def edge(source, target, transform=None):
    pair = FragmentPair(IDS[source], IDS[target])
    truth = relative(POSES[pair.source], POSES[pair.target])
    return Measurement(pair, truth if transform is None else transform)


def test_support_counts_the_triangles_that_close_whatever_their_direction():
    measurements = [edge(0, 1), edge(2, 1), edge(0, 2), edge(3, 0), edge(1, 3), edge(3, 4)]
    assert triangle_support(measurements, 0.1, 0.1).tolist() == [2, 1, 1, 1, 1, 0]


def test_a_wrong_edge_supports_nothing():
    measurements = [edge(0, 1), edge(1, 2), edge(0, 2, WRONG)]
    assert triangle_support(measurements, 0.1, 0.1).tolist() == [0, 0, 0]


def test_limits_are_of_translation_and_of_rotation():
    truth = edge(0, 2).T_target_source
    shifted = [edge(0, 1), edge(1, 2), edge(0, 2, truth @ from_yaw(0.0, (0.3, 0, 0)))]
    turned = [edge(0, 1), edge(1, 2), edge(0, 2, truth @ from_yaw(0.3, (0, 0, 0)))]
    assert triangle_support(shifted, 0.4, 0.1).tolist() == [1, 1, 1]
    assert triangle_support(shifted, 0.2, 0.1).tolist() == [0, 0, 0]
    assert triangle_support(turned, 10.0, 0.4).tolist() == [1, 1, 1]
    assert triangle_support(turned, 10.0, 0.2).tolist() == [0, 0, 0]


def test_two_measurements_of_a_pair_are_two_edges():
    measurements = [edge(0, 1), edge(1, 0), edge(1, 2), edge(0, 2)]
    assert triangle_support(measurements, 0.1, 0.1).tolist() == [1, 1, 2, 2]


def test_no_measurements_have_no_support():
    assert triangle_support([], 0.1, 0.1).tolist() == []


def test_components_are_the_largest_first():
    groups = components(IDS, [edge(4, 3), edge(3, 2)])
    assert groups == [[IDS[2], IDS[3], IDS[4]], [IDS[0]], [IDS[1]]]


def test_the_tree_takes_the_best_ranked_edges():
    measurements = [edge(0, 1), edge(1, 2), edge(0, 2, WRONG)]
    ranks = np.array([[1.0], [1.0], [0.0]])
    poses = spanning_tree_poses(IDS[:3], measurements, ranks)
    for id_ in IDS[:3]:
        assert np.allclose(poses[id_], relative(POSES[id_], POSES[IDS[0]]))
