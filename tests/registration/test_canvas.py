"""Features of many fragments on one canvas, by the bundled bag."""

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nss_ros.bag import read_log
from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw, inverse, relative, rotation_angle
from nss_ros.multiway.solver import prepared_by
from nss_ros.registration.gravity.canvas import Canvas, canvas_score, canvas_search
from nss_ros.registration.gravity.correlation import score_parts
from nss_ros.registration.gravity.network import as_target

_BAG = Path(__file__).parents[2] / "bags" / "three_stages"
FIRST = [FragmentId("1", 1, spot) for spot in (1, 2, 4, 6)]
NEXT = [FragmentId("1", 1, spot) for spot in (8, 9)]
SECOND = [FragmentId("1", 2, spot) for spot in (4, 5, 6, 7)]

yaws = st.floats(-math.pi, math.pi)
metres = st.floats(-3, 3)


class Area:
    """Some of the fragments of a building, with their true poses."""

    def __init__(self):
        log = read_log(_BAG)
        (graph,) = log.ground_truth
        ids = {*FIRST, *NEXT, *SECOND}
        self.poses = {id_: graph.poses()[id_].T_map_fragment for id_ in ids}
        self.prepared = prepared_by(MultiwayConfig(), (log.fragments[id_] for id_ in sorted(ids)))

    def part(self, ids, frame=None):
        """Poses in a frame that is given in that of the first fragment."""
        origin = self.poses[ids[0]] @ (np.eye(4) if frame is None else frame)
        return {id_: relative(self.poses[id_], origin) for id_ in ids}

    def canvas(self, ids, frame=None):
        return Canvas.of(self.part(ids, frame), self.prepared)

    def truth(self, source, target):
        return relative(self.poses[source[0]], self.poses[target[0]])


@pytest.fixture(scope="module")
def area():
    return Area()


def pair_scores(area, source, target, transform, same_stage):
    """What descriptors, normals and free space say of a pair of fragments."""
    maps = [
        torch.from_numpy(area.prepared[each].maps[int(same_stage)].astype(np.float32))
        for each in (source, target)
    ]
    yaw = torch.tensor([math.atan2(transform[1, 0], transform[0, 0])])
    shift = torch.from_numpy(transform[:2, 3][None]).float()
    return score_parts(maps[0], as_target(maps[1]), yaw.float(), shift)[0].tolist()


@settings(max_examples=15)
@given(yaws, metres, metres)
def test_two_canvases_of_one_fragment_score_as_the_pair_does(area, yaw, x, y):
    source, target = FIRST[0], SECOND[1]
    truth = area.truth([source], [target])
    for pose in (truth, truth @ from_yaw(yaw, (x, y, 0))):
        expected = sum(pair_scores(area, source, target, pose, False))
        score = canvas_score(area.canvas([source]), area.canvas([target]), pose)
        assert score == pytest.approx(expected, abs=0.6)


@settings(max_examples=10)
@given(yaws, metres, metres)
def test_within_a_stage_descriptors_and_normals_are_those_of_the_stage(area, yaw, x, y):
    source, target = FIRST[0], FIRST[2]
    truth = area.truth([source], [target])
    for pose in (truth, truth @ from_yaw(yaw, (x, y, 0))):
        *_, free_space = pair_scores(area, source, target, pose, False)
        descriptors, normals, _ = pair_scores(area, source, target, pose, True)
        score = canvas_score(area.canvas([source]), area.canvas([target]), pose)
        assert score == pytest.approx(descriptors + normals + free_space, abs=0.8)


def test_the_true_pose_scores_far_more_than_any_other(area):
    source, target = area.canvas(SECOND), area.canvas(FIRST)
    truth = area.truth(SECOND, FIRST)
    best = canvas_score(source, target, truth)
    assert best > 20
    for yaw, x, y in ((0.6, 0, 0), (math.pi, 0, 0), (0, 1.5, 0), (0, 0, -2), (-1, 1, 1)):
        assert canvas_score(source, target, truth @ from_yaw(yaw, (x, y, 0))) < best - 10


def test_stages_that_do_not_agree_do_not_hide_one_that_does(area):
    """The next stage still looks like a building that later changed past recognition."""
    source, target = area.canvas(SECOND), area.canvas(FIRST)
    truth = area.truth(SECOND, FIRST)
    best = canvas_score(source, target, truth)
    poses = area.part(FIRST)
    for stage, (yaw, x, y) in ((3, (1.0, 0, 0)), (4, (2.0, 0.5, -0.5))):
        changed = {
            FragmentId(id_.area, stage, id_.spot): from_yaw(yaw, (x, y, 0)) @ pose
            for id_, pose in poses.items()
        }
        seen = {id_: area.prepared[FragmentId(id_.area, 1, id_.spot)] for id_ in changed}
        target = target.extended(changed, seen)
        assert canvas_score(source, target, truth) > best - 0.5


def test_canvases_that_do_not_touch_say_nothing(area):
    source, target = area.canvas(SECOND), area.canvas(FIRST)
    assert canvas_score(source, target, from_yaw(0.3, (40, 0, 0))) == 0


@settings(max_examples=10)
@given(yaws, st.floats(-1, 1), st.floats(-1, 1))
def test_exchanging_source_and_target_changes_little(area, yaw, x, y):
    one, other = area.canvas(SECOND), area.canvas(FIRST)
    pose = area.truth(SECOND, FIRST) @ from_yaw(yaw, (x, y, 0))
    forth, back = canvas_score(one, other, pose), canvas_score(other, one, inverse(pose))
    assert forth == pytest.approx(back, abs=1.5)


@settings(max_examples=10)
@given(yaws, st.floats(-30, 30), st.floats(-30, 30))
def test_the_frame_of_a_canvas_changes_little(area, yaw, x, y):
    frame = from_yaw(yaw, (x, y, 0))
    target, truth = area.canvas(FIRST), area.truth(SECOND, FIRST)
    usual = canvas_score(area.canvas(SECOND), target, truth)
    turned = canvas_score(area.canvas(SECOND, frame), target, truth @ frame)
    assert turned == pytest.approx(usual, rel=0.1)


def test_fragments_may_be_added_at_once_or_later(area):
    poses = area.part(FIRST + NEXT)
    whole = Canvas.of(poses, area.prepared)
    grown = Canvas.of({FIRST[0]: poses[FIRST[0]]}, area.prepared)
    for id_ in (*FIRST[1:], *NEXT):
        grown = grown.extended({id_: poses[id_]}, area.prepared)
    source, truth = area.canvas(SECOND), area.truth(SECOND, FIRST)
    for pose in (truth, truth @ from_yaw(0.7, (0.5, 0.5, 0))):
        expected = canvas_score(source, whole, pose)
        assert canvas_score(source, grown, pose) == pytest.approx(expected, rel=0.1, abs=0.5)
    assert float(grown.layers[1].seen.sum()) == pytest.approx(
        float(whole.layers[1].seen.sum()), rel=1e-3
    )


def test_a_canvas_is_never_changed(area):
    poses = area.part(FIRST + NEXT)
    canvas = area.canvas(FIRST)
    sums = {
        stage: (each.across.clone(), each.seen.clone()) for stage, each in canvas.layers.items()
    }
    features = canvas.features.clone()
    canvas.extended({id_: poses[id_] for id_ in NEXT}, area.prepared)
    canvas.extended({FIRST[0]: poses[FIRST[0]]}, area.prepared)
    assert torch.equal(canvas.features, features)
    for stage, (across, seen) in sums.items():
        assert torch.equal(canvas.layers[stage].across, across)
        assert torch.equal(canvas.layers[stage].seen, seen)


def test_one_fragment_far_away_is_still_on_the_canvas(area):
    poses = area.part(FIRST)
    far = poses | {NEXT[0]: from_yaw(1.0, (25, -8, 0))}
    canvas = Canvas.of(far, area.prepared)
    alone = area.canvas([NEXT[0]])
    assert canvas_score(alone, canvas, far[NEXT[0]]) > 20


@pytest.mark.parametrize("x", [25.0, -25.0])
@pytest.mark.parametrize("turned", [False, True])
def test_the_search_finds_a_fragment_at_the_end_of_a_long_canvas(area, x, turned):
    truth = from_yaw(1.0, (x, -8, 0))
    long = Canvas.of(area.part(FIRST) | {NEXT[0]: truth}, area.prepared)
    alone = area.canvas([NEXT[0]])
    if turned:
        error = canvas_search(long, alone, 5)[0] @ truth
    else:
        error = relative(canvas_search(alone, long, 5)[0], truth)
    assert np.linalg.norm(error[:2, 3]) < 0.4
    assert np.degrees(rotation_angle(error)) < 6


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize(("source", "target"), [(SECOND, FIRST), (NEXT, FIRST), (FIRST, SECOND)])
def test_the_search_finds_the_true_pose(area, source, target, yaw):
    frame = from_yaw(yaw, (2.0, -1.0, 0))
    found = canvas_search(area.canvas(source, frame), area.canvas(target), 20)
    truth = area.truth(source, target) @ frame
    errors = [relative(each, truth) for each in found]
    near = [
        np.linalg.norm(error[:2, 3]) < 0.4 and np.degrees(rotation_angle(error)) < 6
        for error in errors
    ]
    assert any(near)


def test_the_poses_of_a_search_are_few_apart_and_level(area):
    source, target = area.canvas(SECOND), area.canvas(FIRST)
    for count in (1, 5, 20):
        found = canvas_search(source, target, count)
        assert 1 <= len(found) <= count
        for pose in found:
            assert pose[2, 3] == 0
            assert pose[2, 2] == pytest.approx(1)
        middle = np.array([*source.centre, 0, 1])
        for one, other in combinations(found, 2):
            moved = np.linalg.norm((one - other) @ middle)
            turned = rotation_angle(relative(one, other))
            assert moved > 0.3 or turned > np.radians(9)


def test_the_poses_of_a_search_come_best_first(area):
    source, target = area.canvas(SECOND), area.canvas(FIRST)
    found = canvas_search(source, target, 20)
    scores = [canvas_score(source, target, each) for each in found]
    assert scores[0] > max(scores) - 5


def test_the_same_bytes_come_again(area):
    found = [
        [each.tobytes() for each in canvas_search(area.canvas(SECOND), area.canvas(FIRST), 20)]
        for _ in range(2)
    ]
    assert found[0] == found[1]
