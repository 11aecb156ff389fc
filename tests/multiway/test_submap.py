"""Submaps of the bundled bag, registered with each other; and what they need of a fragment."""

from dataclasses import replace

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, inverse, relative, rotation_angle
from nss_ros.multiway.agglomeration import Ambiguous
from nss_ros.multiway.solver import prepared_by
from nss_ros.multiway.spanning_tree import Closeness
from nss_ros.multiway.submap import Submap, SubmapLink, polished, register_submaps
from nss_ros.multiway.submaps import Submaps
from nss_ros.registration.gravity.canvas import canvas_score

CLOSE = Closeness(0.4, np.radians(6))
STRANGE = FragmentId("1", 2, 77)
# Logarithm of the odds above which submaps are joined though nobody asked: a little less.
SURE = 5.0


@pytest.fixture(scope="module")
def first(building):
    return building.spots(1, 1, 2, 4, 6, 7)


@pytest.fixture(scope="module")
def second(building):
    return building.spots(2, 4, 5, 6, 7)


@pytest.fixture(scope="module")
def synchronizer():
    return Submaps(MultiwayConfig())


def is_right(building, link, source, target):
    distance, angle = building.error(link.T_target_source, source[0], target[0])
    return distance < 0.2 and angle < 3


def plane(axis):
    points = np.random.default_rng(3).uniform(-3, 3, (6000, 3))
    points[:, axis] = -1.6 if axis == 2 else 2.0
    return points


UNREGISTRABLE = {
    "one wall": plane(0),
    "only a floor": plane(2),
    "noise": np.random.default_rng(0).normal(0, 2, (3000, 3)),
}


@pytest.mark.parametrize("stages", [(1, 2), (2, 1), (1, 3), (2, 3)])
def test_submaps_of_two_stages_are_registered_without_pairs(building, stages):
    spots = {1: (1, 2, 4, 6, 7), 2: (4, 5, 6, 7), 3: (4, 5, 9)}
    source, target = (building.spots(stage, *spots[stage]) for stage in stages)
    link = register_submaps(building.submap(source), building.submap(target), [], CLOSE)
    assert link.odds > SURE
    assert is_right(building, link, source, target)


def test_submaps_of_one_stage_are_registered_without_pairs(building, first):
    beside = building.spots(1, 8, 9, 10)
    link = register_submaps(building.submap(beside), building.submap(first), [], CLOSE)
    assert link.odds > SURE
    assert building.error(link.T_target_source, beside[0], first[0])[0] < 0.3


@pytest.mark.parametrize("shift", [(0.25, 0, 0), (0, -0.3, 0), (-0.2, 0.25, 0)])
@pytest.mark.parametrize("larger", [True, False])
def test_a_link_that_is_a_little_off_is_polished(building, first, second, shift, larger):
    """Farther than ICP goes back."""
    ids = (second, [*first, *building.spots(1, 7)]) if larger else (first, second[:2])
    source, target = (building.submap(each) for each in ids)
    truth = building.truth(FragmentPair(ids[0][0], ids[1][0]))
    off = truth.copy()
    off[:3, 3] += shift
    link = polished(SubmapLink(4.2, off), source, target, [], CLOSE)
    assert link.odds == 4.2
    distance, angle = building.error(link.T_target_source, ids[0][0], ids[1][0])
    assert distance < 0.05
    assert angle < 3  # of the tripods' tilt
    given = polished(SubmapLink(np.inf, off), source, target, [], CLOSE)
    assert np.array_equal(given.T_target_source, off)


@pytest.mark.parametrize("slid", [(0.6, 0, 0), (0, 0.6, 0)])
def test_one_misplaced_fragment_does_not_keep_its_stage_from_its_place(building, second, slid):
    """Of what was joined before, one fragment of the stage is on the wrong side of a wall."""
    ids = building.spots(1, 1, 2, 4, 6, 7)
    wrong, rest = ids[2], [*ids[:2], *ids[3:]]
    poses = building.part([*second, wrong])
    poses[wrong] = from_yaw(0, slid) @ poses[wrong]
    target = Submap.of(poses, building.prepared)
    link = register_submaps(building.submap(rest), target, [], CLOSE)
    assert link.odds > 0
    assert is_right(building, link, rest, second)


def test_exchanging_the_submaps_inverts_the_link(building, first, second):
    one, other = building.submap(first), building.submap(second)
    forth, back = register_submaps(one, other, [], CLOSE), register_submaps(other, one, [], CLOSE)
    assert forth.odds == back.odds
    assert np.allclose(forth.T_target_source, inverse(back.T_target_source), atol=1e-9)


def test_equally_large_submaps_are_registered_either_way(building, first, second):
    one, other = building.submap(first[:3]), building.submap(second[:3])
    forth, back = register_submaps(one, other, [], CLOSE), register_submaps(other, one, [], CLOSE)
    error = relative(forth.T_target_source, inverse(back.T_target_source))
    assert np.linalg.norm(error[:3, 3]) < 0.1
    assert min(forth.odds, back.odds) > SURE


@pytest.mark.parametrize("yaw", [0.7, -2.0])
def test_the_frame_of_a_submap_does_not_matter(building, first, second, yaw):
    frame = from_yaw(yaw, (3.0, -2.0, 0.4))
    poses = {id_: inverse(frame) @ pose for id_, pose in building.part(second).items()}
    turned = Submap.of(poses, building.prepared)
    link = register_submaps(turned, building.submap(first), [], CLOSE)
    assert link.odds > SURE
    distance, angle = building.error(link.T_target_source @ inverse(frame), second[0], first[0])
    assert distance < 0.2
    assert angle < 3


def test_more_fragments_make_a_link_surer(building, first, second):
    target = building.submap(first)
    odds = [
        register_submaps(building.submap(second[:count]), target, [], CLOSE).odds
        for count in (1, 2, 4)
    ]
    assert odds == sorted(odds)


@pytest.mark.parametrize("cloud", UNREGISTRABLE.values(), ids=UNREGISTRABLE.keys())
def test_what_cannot_be_registered_gets_low_odds(building, first, synchronizer, cloud):
    strange = synchronizer.prepare(Fragment(STRANGE, cloud.astype(np.float32), True))
    submap = Submap.of({STRANGE: np.eye(4)}, {STRANGE: strange})
    for target in (first, first[:1]):
        link = register_submaps(submap, building.submap(target), [], CLOSE)
        assert link.odds < SURE


def test_wrong_pairs_do_not_mislead_submaps_that_see_enough(building, first, second):
    pairs = [
        Ambiguous.of(building.wrong(pair, seed))
        for seed, pair in enumerate(building.asked([*first, *second]))
        if not pair.same_stage
    ]
    assert len(pairs) > 5
    link = register_submaps(building.submap(second), building.submap(first), pairs, CLOSE)
    assert link.odds > 0
    assert is_right(building, link, second, first)


def test_pairs_that_agree_make_a_link_surer(building, first, second):
    source, target = building.submap(second[:1]), building.submap(first[:1])
    pair = FragmentPair(second[0], first[0])
    alone = register_submaps(source, target, [], CLOSE)
    told = register_submaps(source, target, [Ambiguous.of(building.right(pair))], CLOSE)
    assert told.odds > alone.odds
    assert building.error(told.T_target_source, pair.source, pair.target)[0] < 0.2


def test_a_constraint_of_a_person_is_obeyed_whatever_is_seen(building, first, second):
    source, target = building.submap(second), building.submap(first)
    pair = FragmentPair(second[0], first[0])
    mistaken = replace(building.wrong(pair, 2), manual=True)
    sure = [building.right(each) for each in building.asked([*first, *second])]
    others = [Ambiguous.of(m) for m in sure if not m.pair.same_stage and m.pair != pair]
    for pairs in ([], others):
        link = register_submaps(source, target, [*pairs, Ambiguous.of(mistaken)], CLOSE)
        assert link.odds == np.inf
        error = relative(link.T_target_source, mistaken.T_target_source)
        assert np.linalg.norm(error[:3, 3]) < 0.4
        assert np.degrees(rotation_angle(error)) < 6


def test_of_constraints_that_contradict_most_are_obeyed(building, first, second):
    source, target = building.submap(second[:3]), building.submap(first[:3])
    right = [
        building.right(FragmentPair(*each), manual=True)
        for each in zip(second[:2], first[:2], strict=True)
    ]
    wrong = replace(building.wrong(FragmentPair(second[2], first[2]), 5), manual=True)
    pairs = [Ambiguous.of(m) for m in (wrong, *right)]
    link = register_submaps(source, target, pairs, CLOSE)
    assert link.odds == np.inf
    assert is_right(building, link, second, first)


def test_the_height_between_submaps_is_found(building, first, second):
    truth = relative(building.poses[second[0]], building.poses[first[0]])
    link = register_submaps(building.submap(second), building.submap(first), [], CLOSE)
    assert link.T_target_source[2, 3] == pytest.approx(truth[2, 3], abs=0.1)


def test_the_same_link_comes_again(building, first, second):
    links = [
        register_submaps(building.submap(second), building.submap(first), [], CLOSE)
        for _ in range(2)
    ]
    assert links[0].odds == links[1].odds
    assert links[0].T_target_source.tobytes() == links[1].T_target_source.tobytes()


def test_joined_submaps_are_those_of_all_fragments(building, first, second):
    source, target = building.submap(second), building.submap(first)
    truth = relative(building.poses[second[0]], building.poses[first[0]])
    joined, whole = target.joined(source, truth, building.prepared), building.part(first + second)
    assert joined.poses.keys() == joined.scans.keys() == whole.keys()
    for id_, pose in joined.poses.items():
        assert np.allclose(pose, whole[id_])
    all_ = Submap.of(whole, building.prepared)
    third = building.spots(3, 4, 5)
    there = relative(building.poses[third[0]], building.poses[first[0]])
    small = building.submap(third).canvas
    scores = [canvas_score(small, each.canvas, there) for each in (joined, all_)]
    assert scores[0] == pytest.approx(scores[1], rel=0.1)
    assert target.poses.keys() == set(first)


def test_features_at_a_fragments_own_floor_are_the_same(building, first):
    fragment = building.prepared[first[0]]
    again = fragment.at_floor(fragment.floor)
    assert again.maps.tobytes() == fragment.maps.tobytes()
    assert again.seen.tobytes() == fragment.seen.tobytes()
    assert again.floor == fragment.floor


def test_features_at_another_floor_are_others_of_the_same_points(building, first):
    fragment = building.prepared[first[0]]
    raised = fragment.at_floor(fragment.floor + 0.3)
    assert raised.floor == fragment.floor + 0.3
    assert raised.maps.shape == fragment.maps.shape
    assert np.abs(raised.maps.astype(float) - fragment.maps.astype(float)).max() > 0.1
    assert raised.points is fragment.points
    back = raised.at_floor(fragment.floor)
    assert back.maps.tobytes() == fragment.maps.tobytes()


def test_a_fragment_on_a_raised_floor_is_seen_from_that_of_its_submap(building, first):
    raised = FragmentId("1", 1, 70)
    prepared = dict(building.prepared)
    prepared[raised] = prepared[first[0]].at_floor(prepared[first[0]].floor + 0.4)
    part = building.part(first[:3])
    submap = Submap.of(part, prepared)
    mistaken = Submap.of(
        {raised if id_ == first[0] else id_: pose for id_, pose in part.items()}, prepared
    )
    assert mistaken.floor == pytest.approx(submap.floor, abs=0.1)
    source = building.submap(building.spots(2, 5, 6, 7))
    truth = relative(building.poses[next(iter(source.poses))], building.poses[first[0]])
    expected = canvas_score(source.canvas, submap.canvas, truth)
    assert canvas_score(source.canvas, mistaken.canvas, truth) == pytest.approx(expected, rel=0.1)


def test_what_was_seen_is_a_share(building):
    for fragment in building.prepared.values():
        assert fragment.seen.shape == fragment.maps.shape[2:]
        assert fragment.seen.min() >= 0
        assert 0.5 < fragment.seen.max() <= 1
        assert np.isfinite(fragment.maps).all()
        assert np.allclose(np.linalg.norm(fragment.normals, axis=1), 1, atol=1e-3)


def test_all_levelled_fragments_are_prepared(building):
    assert building.prepared.keys() == building.fragments.keys()
    assert all(id_ == fragment.id for id_, fragment in building.prepared.items())


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.ones((1, 3)), np.full((500, 3), np.nan), np.ones((5000, 3))],
    ids=["empty", "one point", "no finite point", "equal points"],
)
def test_clouds_of_nothing_are_not_prepared(synchronizer, points):
    assert synchronizer.prepare(Fragment(STRANGE, points.astype(np.float32), True)) is None


def test_fragments_that_are_tilted_are_not_prepared(building, first):
    fragment = building.fragments[first[0]]
    tilted = Fragment(fragment.id, fragment.points, False)
    assert prepared_by(MultiwayConfig(), [tilted]) == {}


def test_points_that_are_not_numbers_are_left_out(building, first, synchronizer):
    fragment = building.fragments[first[0]]
    holes = np.insert(fragment.points, slice(0, None, 7), np.nan, axis=0)
    prepared = synchronizer.prepare(Fragment(fragment.id, holes, True))
    assert prepared.maps.tobytes() == building.prepared[fragment.id].maps.tobytes()
