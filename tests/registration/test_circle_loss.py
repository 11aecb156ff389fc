import math

import pytest
import torch

from nss_ros.registration.learned.training.circle_loss import circle_loss

SCALE = 10


def loss_of(described, apart, weights=None):
    return circle_loss(described, apart < 1.5, apart > 4, SCALE, weights)


def row_loss(described, apart):
    """Equation 8 of the Predator paper for one point, number by number."""
    pull = push = 0.0
    for distance, truth in zip(described, apart, strict=True):
        if truth < 1.5:
            pull += math.exp(10 * max(distance - 0.1, 0) * (distance - 0.1))
        elif truth > 4:
            push += math.exp(10 * max(1.4 - distance, 0) * (1.4 - distance))
    return math.log(1 + pull * push) / 10 if pull and push else None


def test_it_is_the_sum_over_all_positives_and_negatives():
    random = torch.Generator().manual_seed(0)
    described = 2 * torch.rand(9, 12, generator=random, dtype=torch.float64)
    apart = 8 * torch.rand(9, 12, generator=random, dtype=torch.float64)
    sides = []
    for rows in (zip(described, apart, strict=True), zip(described.T, apart.T, strict=True)):
        losses = [row_loss(one.tolist(), other.tolist()) for one, other in rows]
        sides.append([each for each in losses if each is not None])
    assert len(sides[0]) < 9 or len(sides[1]) < 12  # some have no positive
    expected = sum(sum(each) / len(each) for each in sides) / 2
    assert float(loss_of(described, apart)) == pytest.approx(expected)


def test_ideal_distances_cost_less_than_wrong_ones():
    apart = torch.full((6, 6), 10.0).fill_diagonal_(0)
    ideal = torch.full((6, 6), 1.41).fill_diagonal_(0.05)
    alike = torch.full((6, 6), 0.05)
    ideal_loss, alike_loss = (loss_of(each, apart) for each in (ideal, alike))
    assert ideal_loss < 0.2 < alike_loss
    assert loss_of(ideal.roll(1, 0), apart) > alike_loss


def test_neither_here_nor_there_costs_nothing():
    described = torch.rand(5, 5, requires_grad=True)
    loss = loss_of(described, torch.full((5, 5), 2.0))
    loss.backward()
    assert loss == 0
    assert torch.equal(described.grad, torch.zeros(5, 5))


def test_gradients_pull_positives_and_push_negatives():
    described = torch.full((3, 3), 0.7, requires_grad=True)
    apart = torch.full((3, 3), 9.0).fill_diagonal_(0.5)
    loss_of(described, apart).backward()
    assert (described.grad.diagonal() > 0).all()
    assert (described.grad[~torch.eye(3, dtype=torch.bool)] < 0).all()


def test_positives_of_no_weight_pull_less():
    apart = torch.full((3, 3), 9.0).fill_diagonal_(0.5)
    described = torch.full((3, 3), 0.7)
    light, heavy = (loss_of(described, apart, torch.full((3, 3), weight)) for weight in (0.2, 1.0))
    assert light < heavy
    assert heavy == loss_of(described, apart)
