"""Pose graphs in the frames of standpoints, and in those that fragments came in."""

from dataclasses import replace

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import Fragment, FragmentPair
from nss_ros.geometry import inverse, relative, rotation_angle, transform_points
from nss_ros.multiway.pose_graph import Alternative, EdgeStatus
from nss_ros.multiway.solver import prepared_by
from nss_ros.multiway.standpoints import between_standpoints, graph_of_fragments
from nss_ros.multiway.submaps import Submaps
from nss_ros.standpoint import is_origin, shift

FOOT = shift((0.0, 0.0, 1.6))


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2, 4, 6), *building.spots(2, 4, 5)]


@pytest.fixture(scope="module")
def moved(ids):
    """The origin of two fragments is the foot of the tripod, the others' are their sensors."""
    return {ids[0]: FOOT, ids[4]: FOOT}


def in_frames(m, moved):
    """A measurement between sensor frames, between the frames that the fragments came in."""
    return between_standpoints(m, {id_: inverse(place) for id_, place in moved.items()})


def test_a_measurement_there_and_back(building, ids, moved):
    pair = FragmentPair(ids[4], ids[0])
    m = building.right(pair)
    m = replace(m, alternatives=(Alternative(m.T_target_source, m.information, 0.1),))
    there = in_frames(m, moved)
    expected = FOOT @ m.T_target_source @ inverse(FOOT)
    assert np.allclose(there.T_target_source, expected)
    assert np.allclose(there.alternatives[0].T_target_source, expected)
    assert not np.allclose(there.information, m.information)
    back = between_standpoints(there, moved)
    assert np.allclose(back.T_target_source, m.T_target_source)
    assert np.allclose(back.information, m.information)
    assert np.allclose(back.alternatives[0].information, m.information)


def test_without_any_all_stays_as_it_is(building, ids):
    m = building.right(FragmentPair(ids[1], ids[0]))
    assert between_standpoints(m, {}) is m
    assert between_standpoints(m, {ids[4]: FOOT}) is m


def test_submaps_place_fragments_whose_origin_is_on_the_floor(building, ids, moved):
    synchronizer = Submaps(MultiwayConfig())
    fragments = [
        Fragment(
            id_,
            transform_points(moved.get(id_, np.eye(4)), building.fragments[id_].points).astype(
                np.float32
            ),
            True,
        )
        for id_ in ids
    ]
    prepared = prepared_by(MultiwayConfig(), fragments)
    assert {id_ for id_ in ids if not is_origin(prepared[id_].standpoint)} == moved.keys()
    answers = [building.right(pair) for pair in building.asked(ids)]
    graph = synchronizer.synchronize_points(ids, [in_frames(m, moved) for m in answers], prepared)
    poses = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
    assert poses.keys() == set(ids)
    assert np.allclose(poses[ids[0]], np.eye(4))
    sensors = {id_: pose @ moved.get(id_, np.eye(4)) for id_, pose in poses.items()}
    distance, angle = building.worst(sensors)
    assert distance < 0.15
    assert angle < 3
    for edge in graph.edges:
        assert edge.status is EdgeStatus.ACCEPTED
        there = relative(poses[edge.pair.source], poses[edge.pair.target])
        error = inverse(edge.T_target_source) @ there
        assert np.isclose(edge.residual_translation, np.linalg.norm(error[:3, 3]), atol=1e-6)
        assert np.isclose(edge.residual_rotation, rotation_angle(error), atol=1e-6)


def test_a_graph_of_standpoints_becomes_one_of_fragments(building, ids, moved):
    answers = [building.right(pair) for pair in building.asked(ids)]
    graph = Submaps(MultiwayConfig()).synchronize(ids, answers)
    assert graph_of_fragments(graph, {}) is graph
    there = graph_of_fragments(graph, moved)
    before, after = graph.poses(), there.poses()
    for id_ in ids:
        old = relative(before[id_].T_map_fragment, before[ids[0]].T_map_fragment)
        new = relative(after[id_].T_map_fragment, after[ids[0]].T_map_fragment)
        place = moved.get(id_, np.eye(4))
        assert np.allclose(new, FOOT @ old @ inverse(place), atol=1e-9)
        assert np.linalg.eigvalsh(after[id_].covariance)[0] > -1e-9


def test_origins_are_taken_for_standpoints_on_request(building, ids):
    fragment = building.fragments[ids[0]]
    lifted = Fragment(fragment.id, transform_points(FOOT, fragment.points).astype(np.float32), True)
    for search in (True, False):
        (prepared,) = prepared_by(MultiwayConfig(find_standpoints=search), [lifted]).values()
        assert is_origin(prepared.standpoint) != search
