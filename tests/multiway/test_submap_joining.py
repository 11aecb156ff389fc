"""Submaps joined to larger ones, from pairs that are ambiguous, wrong or were never asked for."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.agglomeration import joined_parts
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.solver import prepared_by
from nss_ros.multiway.submap import SubmapLink
from nss_ros.multiway.submap_joining import Joining, _straight_parts, joined_submaps

CHOI = Choi(MultiwayConfig())


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2, 4, 6, 7), *building.spots(2, 4, 5, 6, 7)]


@pytest.fixture(scope="module")
def pairs(building, ids):
    return building.asked(ids)


def joined(building, ids, measurements):
    return joined_submaps(ids, measurements, building.prepared, CHOI).parts


def assert_right(building, part):
    distance, angle = building.worst(part)
    assert distance < 0.25
    assert angle < 3


def test_true_pairs_give_one_submap(building, ids, pairs):
    (part,) = joined(building, ids, [building.right(pair) for pair in pairs])
    assert part.keys() == set(ids)
    assert_right(building, part)


@pytest.mark.parametrize("seed", [0, 100])
def test_all_is_joined_rightly_when_every_pair_prefers_what_is_wrong(building, ids, pairs, seed):
    measurements = [
        building.wrong(pair, seed + number, confidence=0.5, right=0.3)
        for number, pair in enumerate(pairs)
    ]
    (part,) = joined(building, ids, measurements)
    assert part.keys() == set(ids)
    assert_right(building, part)


def test_stages_without_any_pair_between_them_are_linked_by_a_search(building, ids, pairs):
    within = [building.right(pair) for pair in pairs if pair.same_stage]
    (part,) = joined(building, ids, within)
    assert part.keys() == set(ids)
    assert_right(building, part)


def test_stages_with_wrong_pairs_between_them_are_joined_rightly(building, ids, pairs):
    measurements = [
        building.right(pair) if pair.same_stage else building.wrong(pair, number)
        for number, pair in enumerate(pairs)
    ]
    (part,) = joined(building, ids, measurements)
    assert part.keys() == set(ids)
    assert_right(building, part)


def test_a_hint_is_enough_where_both_saw_the_same(building):
    """A pair that is right with a probability of 0.3 only."""
    source, target = building.spots(2, 5)[0], building.spots(1, 1)[0]
    hint = building.wrong(FragmentPair(source, target), 1, confidence=0.4, right=0.3)
    (part,) = joined(building, [source, target], [hint])
    assert_right(building, part)


def test_few_fragments_are_not_joined_without_pairs(building):
    ids = [*building.spots(1, 1, 2), *building.spots(2, 5, 6)]
    parts = joined(building, ids, [])
    assert [list(part) for part in parts] == [[id_] for id_ in sorted(ids)]


def test_fragments_that_saw_little_come_last_and_do_not_tell_each_others_places(building):
    """Floor and ceiling about a tripod fit in many places, in one of them best."""
    ids = building.spots(1, 1, 2, 4, 6, 7)
    known = [building.right(pair) for pair in building.asked(ids)]
    doubtful = [*building.spots(2, 4), *building.spots(3, 4)]
    clouds = {id_: building.fragments[id_].points for id_ in doubtful}
    little = [
        Fragment(id_, points[np.linalg.norm(points[:, :2], axis=1) < 2.0], True)
        for id_, points in clouds.items()
    ]
    prepared = building.prepared | prepared_by(MultiwayConfig(), little)

    def links(new):
        asked = [
            pair for pair in building.asked([*ids, *new]) if {pair.source, pair.target} & {*new}
        ]
        wrong = [building.wrong(pair, 1, 0.5) for pair in asked]
        joining = Joining([*ids, *new], [*known, *wrong], prepared, CHOI)
        found = {min(other.poses): (odds, link.T_target_source) for odds, _, other, link in joining}
        return found, joining.doubtful

    both, told = links(doubtful)
    assert both.keys() == set(doubtful)
    assert told == set(doubtful)
    for id_ in doubtful:
        alone = links([id_])[0][id_]
        assert 0 <= both[id_][0] < 3
        assert both[id_][0] == alone[0]
        np.testing.assert_array_equal(both[id_][1], alone[1])


def elsewhere(building, ids):
    """The same fragments in another area, with what was prepared of them."""
    others = {id_: FragmentId("2", id_.stage, id_.spot) for id_ in ids}
    prepared = building.prepared | {
        other: replace(building.prepared[id_], id=other) for id_, other in others.items()
    }
    return others, prepared


def test_two_areas_are_never_joined(building, ids, pairs):
    """Not even when they look the same."""
    others, prepared = elsewhere(building, ids)
    measurements = [building.right(pair) for pair in pairs]
    measurements += [
        replace(m, pair=FragmentPair(others[m.pair.source], others[m.pair.target]))
        for m in measurements
    ]
    parts = joined_submaps([*ids, *others.values()], measurements, prepared, CHOI).parts
    assert [part.keys() for part in parts] == [set(ids), set(others.values())]


def test_nothing_and_one_fragment_are_no_problem(building, ids):
    assert joined(building, [], []) == []
    (part,) = joined(building, ids[:1], [])
    assert list(part) == ids[:1]
    assert np.array_equal(part[ids[0]], np.eye(4))


def test_every_fragment_is_in_one_part_the_largest_first(building, pairs, ids):
    apart = building.spots(3, 1, 7)
    parts = joined(building, [*apart, *ids], [building.right(pair) for pair in pairs])
    assert sorted(id_ for part in parts for id_ in part) == sorted([*apart, *ids])
    sizes = [len(part) for part in parts]
    assert sizes == sorted(sizes, reverse=True) == [len(ids), 1, 1]


def test_the_order_of_the_fragments_does_not_matter(building, ids, pairs):
    measurements = [building.wrong(pair, n, 0.5, 0.3) for n, pair in enumerate(pairs)]
    forth = joined(building, ids, measurements)
    back = joined(building, ids[::-1], measurements)
    assert [part.keys() for part in forth] == [part.keys() for part in back]
    for one, other in zip(forth, back, strict=True):
        assert all(one[id_].tobytes() == other[id_].tobytes() for id_ in one)


def test_each_step_joins_two_submaps_that_are_sure(building, ids, pairs):
    measurements = [building.wrong(pair, n, 0.5, 0.3) for n, pair in enumerate(pairs)]
    joining = Joining(ids, measurements, building.prepared, CHOI)
    count = len(joining.submaps)
    assert count > 1
    for odds, one, other, link in joining:
        assert odds == link.odds >= 0
        assert not one.poses.keys() & other.poses.keys()
        assert len(joining.submaps) == count
        count -= 1
    assert len(joining.submaps) == count == 1
    assert joining.parts()[0].keys() == set(ids)


def test_a_constraint_of_a_person_joins_what_does_not_touch(building):
    pair = FragmentPair(building.spots(3, 7)[0], building.spots(1, 5)[0])
    (part,) = joined(building, [pair.source, pair.target], [building.right(pair, manual=True)])
    assert_right(building, part)


def dwellings(building, *stages):
    """Two dwellings that look the same: fragments, and measurements of all neighbours in each."""
    prepared, measurements = {}, []
    for shift in (0, 100):
        for stage, spots in stages:
            for id_ in building.spots(stage, *spots):
                other = FragmentId(id_.area, id_.stage, id_.spot + shift)
                prepared[other] = replace(building.prepared[id_], id=other)
    for source, target in combinations(sorted(prepared), 2):
        one, other = (building.spots(each.stage, each.spot % 100)[0] for each in (source, target))
        distance = np.linalg.norm(building.poses[one][:3, 3] - building.poses[other][:3, 3])
        if source.spot // 100 == target.spot // 100 and distance < 4:
            right = building.right(FragmentPair(one, other))
            measurements.append(replace(right, pair=FragmentPair(source, target)))
    return prepared, measurements


def test_like_dwellings_of_which_nobody_asks_are_not_laid_on_one_another(building):
    prepared, measurements = dwellings(building, (1, (1, 2, 4, 6, 7, 8)), (2, (4, 5, 6, 7)))
    parts = joined_submaps(prepared, measurements, prepared, CHOI).parts
    assert [{id_.spot // 100 for id_ in part} for part in parts] == [{0}, {1}]
    assert [len(part) for part in parts] == [10, 10]


def test_stages_of_like_dwellings_are_joined_where_no_pair_between_stages_was_asked_for(building):
    prepared, measurements = dwellings(building, (1, (1, 2, 4, 6, 7, 8)), (2, (4, 5, 6, 7)))
    within = [m for m in measurements if m.pair.same_stage]
    parts = joined_submaps(prepared, within, prepared, CHOI).parts
    assert {id_.stage for id_ in parts[0]} == {1, 2}


def test_submaps_are_levelled_by_all_their_tripods(building, ids, pairs):
    """Whatever the frame of the first fragment, which a tripod tilts."""
    joining = Joining(ids, [building.right(p) for p in pairs], building.prepared, CHOI)
    large = [submap.poses for submap in joining.submaps.values() if len(submap.poses) > 2]
    assert large
    for poses in large:
        up = np.mean([pose[:3, 2] for pose in poses.values()], axis=0)
        assert np.allclose(up[:2], 0, atol=1e-9)
        assert building.worst(poses)[1] < 0.1


def test_of_sure_links_those_of_large_submaps_come_first(building, ids, pairs):
    joining = Joining(ids, [building.right(p) for p in pairs], building.prepared, CHOI)
    one, other = sorted(joining.submaps, key=lambda n: -len(joining.submaps[n].poses))[:2]
    size = len(joining.submaps[one].poses)
    assert joining._priority(7.0, one, other) > size
    assert joining._priority(3.0, one, other) == 3.0
    assert joining._priority(np.inf, one, other) == np.inf
    assert joining._priority(20.0, one, other) > joining._priority(7.0, one, other)
    # What single fragments add would speak against a link of large submaps.
    alone = max(joining.submaps) + 1
    joining.submaps[alone] = building.submap(building.spots(3, 4))
    order = [(7.0, other), (4.0, other), (20.0, alone), (7.0, alone), (5.9, alone)]
    ranks = [joining._priority(odds, one, each) for odds, each in order]
    assert ranks == sorted(ranks, reverse=True)
    assert ranks[-1] == 5.9


def test_two_large_submaps_are_not_joined_by_little(building, ids, pairs):
    """Half of the map would be wrong; a single fragment is joined with as much, but last."""
    joining = Joining(ids, [building.right(p) for p in pairs], building.prepared, CHOI)
    one, other = sorted(joining.submaps, key=lambda n: -len(joining.submaps[n].poses))[:2]
    sizes = [len(joining.submaps[each].poses) for each in (one, other)]
    assert min(sizes) >= 3
    assert joining._is_weak(1.5, one, other)
    assert not joining._is_weak(2.5, one, other)
    link = joining._links[min(one, other), max(one, other)] = SubmapLink(1.5, np.eye(4))
    joining._queue = [(-link.odds, min(one, other), max(one, other), link.odds)]
    assert not list(joining._join_while_sure())
    assert {one, other} <= joining.submaps.keys()


def ring(bend, count=16, radius=6.0):
    """Two halves of a ring of fragments, and two pairs, half sure, at their seams.

    Neighbours are turned by `bend`; fewer and weaker pairs over longer distances are right.
    """
    ids = [FragmentId("1", 1, n) for n in range(count)]
    angles = np.arange(count) * 2 * np.pi / count
    poses = [from_yaw(a, (radius * np.cos(a), radius * np.sin(a), 0.0)) for a in angles]
    middle = count // 2

    def measured(one, other, confidence, inliers, turn=0.0):
        T = relative(poses[one], poses[other]) @ from_yaw(turn, (0, 0, 0))
        pair = FragmentPair(ids[one], ids[other])
        return Measurement(pair, T, np.eye(6) * 2500, confidence, inliers, level=True)

    measurements = [measured(0, count - 1, 0.7, 1000), measured(middle - 1, middle, 0.7, 1000)]
    for half in (range(middle), range(middle, count)):
        measurements += [measured(n, n + 1, 0.97, 1000, bend) for n in half[:-1]]
        measurements += [measured(n, n + 3, 0.6, 4000) for n in half[:-3]]
    return ids, measurements


@pytest.mark.parametrize("bend", [0.0, 0.02, 0.03])
def test_parts_that_fit_each_other_only_when_they_are_straight_are_joined(bend):
    ids, measurements = ring(bend)
    bent = joined_parts(ids, measurements, CHOI.close, 3.0)
    assert len(bent) == (2 if bend else 1)
    (part,) = _straight_parts(ids, measurements, CHOI, lambda *_: 0.0)
    assert part.keys() == set(ids)
