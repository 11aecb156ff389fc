"""What fragments of one stage see of each other, by the bundled bag: right and wrong places."""

import numpy as np
import pytest

from nss_ros.geometry import from_yaw, inverse
from nss_ros.multiway.contradictions import loss_of_pair, loss_of_parts


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


def test_both_parts_are_looked_at_alike(building, ids):
    one, other, truth = halves(building, ids)
    wrong = truth @ from_yaw(0.3, (1, 0, 0))
    forth = loss_of_parts(one, other, wrong, building.prepared)
    back = loss_of_parts(other, one, inverse(wrong), building.prepared)
    assert forth == pytest.approx(back)


def test_what_is_far_apart_or_of_other_stages_loses_nothing(building, ids):
    one, other, _ = halves(building, ids)
    assert loss_of_parts(one, other, from_yaw(0, (40, 0, 0)), building.prepared) == 0
    later = building.part(building.spots(2, 4, 5, 6))
    assert loss_of_parts(one, later, np.eye(4), building.prepared) == 0
