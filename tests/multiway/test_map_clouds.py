"""Clouds of a growing map: made anew where something changed."""

from dataclasses import replace

import numpy as np
import pytest

from nss_ros.geometry import from_yaw
from nss_ros.multiway.map_clouds import MapClouds
from nss_ros.multiway.multi_stage_map import map_points
from nss_ros.multiway.pose_graph import Node, PoseGraph

VOXEL = 0.1


@pytest.fixture
def fragments(room):
    return {fragment.id: fragment for fragment in room.fragments}


@pytest.fixture
def clouds(room, fragments):
    clouds = MapClouds()
    assert clouds.update(fragments, room.ground_truth, VOXEL, VOXEL) == {(0, 1), (0, 2)}
    return clouds


def changed(graph, number, **fields):
    nodes = list(graph.nodes)
    nodes[number] = replace(nodes[number], **fields)
    return replace(graph, nodes=tuple(nodes))


def moved(graph, number, step):
    return changed(graph, number, T_map_fragment=step @ graph.nodes[number].T_map_fragment)


def test_what_is_in_them_is_the_map(room, fragments, clouds):
    for found, expected in zip(
        clouds.component(0), map_points(fragments, room.ground_truth, VOXEL), strict=True
    ):
        np.testing.assert_array_equal(found, expected)
    parts = [clouds.stage(0, stage)[0] for stage in (1, 2)]
    np.testing.assert_array_equal(np.concatenate(parts), clouds.component(0)[0])
    assert clouds.layers() == {(0, 1), (0, 2)}
    for nothing in (clouds.component(1), clouds.stage(0, 9)):
        assert [len(each) for each in nothing] == [0, 0]


def test_only_stages_that_changed_are_made_anew(room, fragments, clouds):
    truth = room.ground_truth
    first = clouds.stage(0, 1)[0]
    assert clouds.update(fragments, truth, VOXEL, 0.0) == set()
    little = moved(truth, 4, from_yaw(0.0, (0.05, 0.0, 0.0)))
    assert clouds.update(fragments, little, VOXEL, VOXEL) == set()
    # What turns moves far away points, though the scanner stays where it is.
    pose = truth.nodes[4].T_map_fragment
    turned = changed(truth, 4, T_map_fragment=pose @ from_yaw(0.05, (0.0, 0.0, 0.0)))
    assert clouds.update(fragments, turned, VOXEL, VOXEL) == {(0, 2)}
    assert clouds.stage(0, 1)[0] is first
    assert clouds.update(fragments, moved(turned, 4, from_yaw(0, (1e-9, 0, 0))), VOXEL, 0.0) == {
        (0, 2)
    }


def test_many_small_steps_are_one_that_is_large(room, fragments, clouds):
    graph, found = room.ground_truth, []
    for _ in range(5):
        graph = moved(graph, 0, from_yaw(0.0, (0.03, 0.0, 0.0)))
        found.append(clouds.update(fragments, graph, VOXEL, VOXEL))
    assert found == [set(), set(), set(), {(0, 1)}, set()]


def test_fragments_come_and_go_and_change_components(room, fragments, clouds):
    truth = room.ground_truth
    without = changed(truth, 5, status=Node(truth.nodes[5].id).status)
    assert clouds.update(fragments, without, VOXEL, VOXEL) == {(0, 2)}
    apart = changed(truth, 5, component=1)
    assert clouds.update(fragments, apart, VOXEL, VOXEL) == {(1, 2)}
    assert len(clouds.component(1)[0]) == len(clouds.stage(1, 2)[0]) > 100
    assert clouds.update(fragments, PoseGraph(), VOXEL, VOXEL) == {(0, 1), (0, 2), (1, 2)}
    assert clouds.layers() == set()


def test_another_voxel_size_and_other_points_count(room, fragments, clouds):
    truth = room.ground_truth
    assert clouds.update(fragments, truth, 2 * VOXEL, VOXEL) == {(0, 1), (0, 2)}
    id_ = truth.nodes[0].id
    again = fragments | {id_: replace(fragments[id_], points=fragments[id_].points[::2])}
    assert clouds.update(again, truth, 2 * VOXEL, VOXEL) == {(0, 1)}
    nothing = fragments | {id_: replace(fragments[id_], points=fragments[id_].points[:0])}
    assert clouds.update(nothing, truth, 2 * VOXEL, VOXEL) == {(0, 1)}
