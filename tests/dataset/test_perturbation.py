from dataclasses import replace

import numpy as np
import pytest

from nss_ros.carrier import without_carrier
from nss_ros.dataset.perturbation import Perturbation
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, inverse, relative, tilt_angle, transform_points
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph

IDS = FragmentId("1", 1, 1), FragmentId("1", 2, 1)
POSES = from_yaw(0.4, (2.0, 1.0, 1.5)), from_yaw(-2.0, (-1.0, 3.0, 1.6))
WORLD = np.random.default_rng(0).uniform(-6, 6, (500, 3))


def fragments():
    """The same world points seen from two poses, in either sensor frame."""
    return [
        Fragment(id_, transform_points(inverse(pose), WORLD).astype(np.float32), True)
        for id_, pose in zip(IDS, POSES, strict=True)
    ]


def truth():
    nodes = [Node(id_, pose, NodeStatus.PLACED) for id_, pose in zip(IDS, POSES, strict=True)]
    nodes.append(Node(FragmentId("1", 2, 9), status=NodeStatus.OUTLIER))
    edge = Edge(FragmentPair(*IDS), relative(*POSES), EdgeKind.DIFFERENT_STAGE, overlap_ratio=0.7)
    return PoseGraph(tuple(nodes), (edge,), "graph")


def test_without_a_perturbation_nothing_changes():
    none = Perturbation()
    for fragment in fragments():
        assert np.array_equal(none.fragment(fragment).points, fragment.points)
    graph = truth()
    assert none.ground_truth(graph) is graph
    assert str(none) == ""


@pytest.mark.parametrize("tilt", [1.0, 3.0, 20.0])
def test_ground_truth_of_tilted_fragments_stays_true(tilt):
    perturbation = Perturbation(tilt=tilt)
    source, target = (perturbation.fragment(each) for each in fragments())
    graph = perturbation.ground_truth(truth())
    (edge,) = graph.edges
    moved = transform_points(edge.T_target_source, source.points)
    assert np.abs(moved - target.points).max() < 1e-4
    assert edge.overlap_ratio == 0.7
    for fragment, node in zip((source, target), graph.nodes, strict=False):
        assert np.abs(transform_points(node.T_map_fragment, fragment.points) - WORLD).max() < 1e-4
        assert np.degrees(tilt_angle(node.T_map_fragment)) == pytest.approx(tilt)
        assert fragment.gravity_aligned
    assert np.array_equal(graph.nodes[2].T_map_fragment, np.eye(4))
    # Otherwise the old truth would do.
    assert np.abs(transform_points(relative(*POSES), source.points) - target.points).max() > 0.01


def test_range_noise_moves_points_along_their_rays():
    (before, _), after = fragments(), Perturbation(range_noise=0.05).fragment(fragments()[0])
    ranges = [np.linalg.norm(points, axis=1) for points in (before.points, after.points)]
    directions = [
        points / length[:, None]
        for points, length in zip((before.points, after.points), ranges, strict=True)
    ]
    assert np.allclose(*directions, atol=1e-5)
    difference = ranges[1] - ranges[0]
    assert abs(difference.mean()) < 0.01
    assert difference.std() == pytest.approx(0.05, rel=0.15)
    graph = truth()
    assert Perturbation(range_noise=0.05).ground_truth(graph) is graph


def test_the_same_fragment_is_perturbed_the_same_and_others_otherwise():
    one, other = fragments()
    both = Perturbation(tilt=2.0, range_noise=0.02)
    assert str(both) == "tilt 2 deg, noise 0.02 m"
    assert np.array_equal(both.fragment(one).points, both.fragment(one).points)
    T_one, T_other = (both.T_tilted_level(each.id) for each in (one, other))
    assert not np.allclose(T_one, T_other, atol=1e-3)
    reseeded = Perturbation(tilt=2.0, range_noise=0.02, seed=1)
    assert not np.allclose(reseeded.fragment(one).points, both.fragment(one).points, atol=1e-3)


def test_floating_points_lie_before_what_is_seen():
    fragment, _ = fragments()
    points = Perturbation(floating=0.2).fragment(fragment).points
    assert np.array_equal(points[: len(fragment.points)], fragment.points)
    added = points[len(fragment.points) :]
    assert len(added) == round(0.2 * len(fragment.points))
    directions, rays = (
        each / np.linalg.norm(each, axis=1)[:, None] for each in (added, fragment.points)
    )
    assert (directions @ rays.T).max(axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.linalg.norm(added, axis=1).max() <= np.linalg.norm(fragment.points, axis=1).max()


def test_a_robot_is_beneath_the_sensor_and_is_left_out_again():
    fragment, _ = fragments()
    carried = Perturbation(robot=True)
    points = carried.fragment(fragment).points
    body = points[len(fragment.points) :]
    assert len(body) > 1000
    assert body[:, 2].max() < -0.2
    assert np.hypot(*body[:, :2].T).max() < 0.6
    assert np.array_equal(without_carrier(points), without_carrier(fragment.points))
    assert str(replace(carried, floating=0.1)) == "10% floating, robot"
