import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.fragment import voxelize
from nss_ros.geometry import from_yaw, inverse, relative
from nss_ros.registration.free_space import RangeImage, View, conflicts


@pytest.fixture(scope="module")
def views(room) -> dict:
    return {
        fragment.id: View(
            voxelize(fragment.points, 0.1).astype(float), RangeImage.of(fragment.points)
        )
        for fragment in room.fragments
    }


def test_a_true_alignment_contradicts_next_to_nothing(views, room):
    for edge in room.ground_truth.edges:
        source, target = views[edge.pair.source], views[edge.pair.target]
        assert conflicts(source, target, edge.T_target_source[None])[0] < 0.03


@given(st.floats(0.8, 2.5), st.floats(-np.pi, np.pi))
def test_a_shifted_alignment_contradicts_more(views, room, distance, direction):
    shift = from_yaw(0, (distance * np.cos(direction), distance * np.sin(direction), 0))
    edge = room.ground_truth.edges[0]
    source, target = views[edge.pair.source], views[edge.pair.target]
    both = np.array([edge.T_target_source, shift @ edge.T_target_source])
    right, wrong = conflicts(source, target, both)
    assert wrong > right + 0.05


def test_source_and_target_are_treated_alike(views, room):
    edge = room.ground_truth.edges[3]
    source, target = views[edge.pair.source], views[edge.pair.target]
    forward = conflicts(source, target, edge.T_target_source[None])
    backward = conflicts(target, source, inverse(edge.T_target_source)[None])
    np.testing.assert_array_equal(forward, backward)


def test_what_shares_no_surface_is_all_conflict(views, room):
    view = views[room.fragments[0].id]
    assert conflicts(view, view, from_yaw(0, (100, 0, 0))[None])[0] == 1


def test_points_behind_a_wall_are_hidden_not_in_conflict():
    rng = np.random.default_rng(0)
    wall = np.column_stack((np.full(20000, 3.0), rng.uniform(-2, 2, (20000, 2))))
    image = RangeImage.of(wall)
    cases = np.array([[[1.0, 0, 0]], [[3.1, 0, 0]], [[5.0, 0, 0]], [[-1.0, 0, 0]]])
    free, on_surface = image.compare(cases)
    assert free.tolist() == [1, 0, 0, 0]
    assert on_surface.tolist() == [0, 1, 0, 0]


def test_a_levelled_pair_is_judged_in_any_map_frame(views, room):
    poses = {node.id: node.T_map_fragment for node in room.ground_truth.nodes}
    one, other = room.fragments[0].id, room.fragments[1].id
    moved = from_yaw(1.0, (5, 6, 0))
    same = relative(moved @ poses[one], moved @ poses[other])
    plain = relative(poses[one], poses[other])
    results = conflicts(views[one], views[other], np.array([plain, same]))
    assert results[0] == pytest.approx(results[1], abs=0.002)
