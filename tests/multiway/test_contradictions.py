"""What fragments of one stage see of each other, by the bundled bag: right and wrong places."""

from dataclasses import replace

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.geometry import from_yaw, inverse
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.contradictions import (
    loss_of_pair,
    loss_of_parts,
    nearest_pairs,
    noise_of,
)
from nss_ros.multiway.solver import prepared_by
from nss_ros.multiway.submap_joining import joined_submaps


@pytest.fixture(scope="module")
def ids(building):
    return building.spots(1, 1, 2, 4, 6, 7)


def pair_loss(building, pair, transform):
    source, target = building.prepared[pair.source], building.prepared[pair.target]
    return loss_of_pair(source, target, transform)


def test_true_hypotheses_within_a_stage_lose_next_to_nothing(building):
    pairs = [pair for pair in building.pairs if pair.same_stage]
    losses = [pair_loss(building, pair, building.truth(pair)) for pair in pairs]
    assert np.percentile(losses, 90) < 1
    assert np.mean(losses) < 0.3


def test_turned_by_half_a_turn_most_lose_much(building):
    turned = from_yaw(np.pi, np.zeros(3))
    pairs = [pair for pair in building.pairs if pair.same_stage]
    losses = [pair_loss(building, pair, building.truth(pair) @ turned) for pair in pairs]
    assert np.mean(losses) > 2


def halves(building, ids):
    """Fragments in two parts, and the true transform from the second to the first."""
    one, other = building.part(ids[:3]), building.part(ids[3:])
    truth = building.part(ids)[ids[3]]
    return one, other, truth


def test_parts_in_their_true_place_lose_nothing(building, ids):
    one, other, truth = halves(building, ids)
    assert loss_of_parts(one, other, truth, building.prepared) < 0.5


def test_parts_laid_over_each_other_wrongly_lose(building, ids):
    one, other, truth = halves(building, ids)
    for move in (from_yaw(np.pi, (0, 0, 0)), from_yaw(0, (1.5, 1.5, 0))):
        assert loss_of_parts(one, other, truth @ move, building.prepared) > 3


def test_each_fragment_tells_once(building, ids):
    """People about one scanner take no more than one fragment may; a wrong place takes more."""
    one, other, truth = halves(building, ids)
    wrong = truth @ from_yaw(np.pi, (0, 0, 0))
    assert loss_of_parts(one, other, wrong, building.prepared) > 8
    crowd = with_people(building.fragments[ids[0]], np.random.default_rng(3))
    prepared = building.prepared | prepared_by(MultiwayConfig(), [crowd])
    assert 0 < loss_of_parts(one, other, truth, prepared) <= 8


def test_both_parts_are_looked_at_alike(building, ids):
    one, other, truth = halves(building, ids)
    wrong = truth @ from_yaw(0.3, (1, 0, 0))
    forth = loss_of_parts(one, other, wrong, building.prepared)
    back = loss_of_parts(other, one, inverse(wrong), building.prepared)
    assert forth == pytest.approx(back)


def test_scanners_that_reach_far_are_looked_at_from_farther_away(building, ids):
    one, other = {ids[0]: np.eye(4)}, {ids[1]: np.eye(4)}
    far = replace(building.prepared[ids[0]], seen=np.zeros((120, 120), dtype=np.float16))
    assert far.reach == pytest.approx(12)
    with_far = building.prepared | {ids[0]: far}
    for metres, usual, wide in ((5, True, True), (8, False, True), (16, False, False)):
        there = from_yaw(0, (metres, 0, 0))
        for prepared, found in ((building.prepared, usual), (with_far, wide)):
            expected = [(ids[1], ids[0])] if found else []
            assert nearest_pairs(one, other, there, prepared, 5) == expected


def test_what_is_far_apart_or_of_other_stages_loses_nothing(building, ids):
    one, other, _ = halves(building, ids)
    assert loss_of_parts(one, other, from_yaw(0, (40, 0, 0)), building.prepared) == 0
    later = building.part(building.spots(2, 4, 5, 6))
    assert loss_of_parts(one, later, np.eye(4), building.prepared) == 0


def test_of_usual_scans_nothing_is_noise(building):
    pairs = [pair for pair in building.pairs if pair.same_stage]
    prepared = building.prepared
    assert noise_of((prepared[p.source], prepared[p.target], building.truth(p)) for p in pairs) == 0
    assert noise_of([]) == 0


def test_noise_is_not_held_against_a_place(building, ids):
    one, other, truth = halves(building, ids)
    wrong = truth @ from_yaw(np.pi, (0, 0, 0))
    losses = [loss_of_parts(one, other, wrong, building.prepared, n) for n in (0, 0.002, 0.2)]
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] == 0
    pair = next(pair for pair in building.pairs if pair.same_stage)
    scans = building.prepared[pair.source], building.prepared[pair.target]
    assert loss_of_pair(*scans, np.eye(4), 0.5) == 0


def with_people(fragment, rng, count=4):
    """The fragment with people about its scanner, and without what they hide."""
    points = fragment.points.astype(np.float64)
    floor = np.percentile(points[:, 2], 2)
    for _ in range(count):
        distance, angle = rng.uniform(1.2, 3.5), rng.uniform(-np.pi, np.pi)
        far = np.hypot(points[:, 0], points[:, 1])
        beside = np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - angle)))
        hidden = (far > distance) & (np.abs(beside) < np.arctan(0.25 / distance))
        hidden &= points[:, 2] * distance / far < floor + 1.75
        around = angle + np.pi + rng.uniform(-np.pi / 2, np.pi / 2, 1500)
        person = np.column_stack(
            (
                distance * np.cos(angle) + 0.25 * np.cos(around),
                distance * np.sin(angle) + 0.25 * np.sin(around),
                floor + rng.uniform(0, 1.75, 1500),
            )
        )
        points = np.vstack((points[~hidden], person))
    return replace(fragment, points=points.astype(np.float32))


def test_people_about_each_scanner_do_not_keep_a_stage_apart(building, ids):
    """Each of them stands where the other scans saw that nothing is."""
    rng = np.random.default_rng(5)
    crowded = [with_people(building.fragments[id_], rng) for id_ in ids]
    prepared = prepared_by(MultiwayConfig(), crowded)
    pairs = building.asked(ids)
    placed = [(prepared[p.source], prepared[p.target], building.truth(p)) for p in pairs]
    noise = noise_of(placed)
    one, other, truth = halves(building, ids)
    assert loss_of_parts(one, other, truth, prepared) > 4
    assert loss_of_parts(one, other, truth, prepared, noise) < 0.5
    choi = Choi(MultiwayConfig())
    (part,) = joined_submaps(ids, [building.right(p) for p in pairs], prepared, choi).parts
    assert building.worst(part)[0] < 0.1
