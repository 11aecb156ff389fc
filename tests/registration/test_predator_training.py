import numpy as np
import pytest
import torch
from training_pair import distant_pair, training_pair

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.registration.learned.training.predator import (
    PredatorTrainee,
    balanced_cross_entropy,
)
from nss_ros.registration.method import load_method

SETTINGS = {"voxel_size": 0.2}


def trainee():
    torch.set_num_threads(1)  # as in training
    torch.manual_seed(0)
    return PredatorTrainee(RegistrationConfig(predator=SETTINGS), torch.device("cpu"))


def prepared(learner, seed=0):
    return learner.prepare(training_pair(), np.random.default_rng(seed))


def test_gradients_reach_all_that_learns():
    learner = trainee()
    losses = learner.losses(prepared(learner))
    assert set(losses) == {"descriptor", "overlap", "saliency"}
    sum(losses.values()).backward()
    for name, parameter in learner.network.named_parameters():
        assert parameter.grad is not None, name


def test_a_pair_without_anything_in_common_is_left_out():
    assert trainee().prepare(distant_pair(), np.random.default_rng(0)) is None


def test_what_is_looked_for_overlaps_and_is_of_the_right_cloud():
    learner = trainee()
    pair = prepared(learner)
    first = pair.levels[0].lengths[0]
    source, target = (side.numpy() for side in pair.looked_for)
    assert source.max() < first <= target.min()
    assert pair.sample.overlap[np.concatenate((source, target))].all()


def test_points_are_found_by_descriptors_that_tell_places_apart():
    learner = trainee()
    pair = prepared(learner)
    first = pair.levels[0].lengths[0]
    positions = torch.from_numpy(pair.sample.positions)
    overlaps = torch.from_numpy(pair.sample.overlap)
    # The nearer in truth, the more alike: (x, |x|^2, 1) . (2y, -1, -|y|^2) = -|x - y|^2 turned.
    norms = positions.square().sum(dim=1, keepdim=True)
    ideal = torch.cat((positions, norms, torch.ones_like(norms)), dim=1)
    asked = torch.cat((2 * positions, -torch.ones_like(norms), -norms), dim=1)
    mixed = torch.where(torch.arange(len(ideal))[:, None] < first, asked, ideal).double()
    found = learner._found(mixed, positions, overlaps, first, pair.looked_for)
    assert found.float().mean() > 0.95
    shuffled = mixed[torch.randperm(len(mixed), generator=torch.Generator().manual_seed(0))]
    lost = learner._found(shuffled, positions, overlaps, first, pair.looked_for)
    assert lost.float().mean() < 0.3


def test_both_classes_weigh_the_same():
    labels = torch.tensor([True] * 2 + [False] * 8)
    probabilities = torch.tensor([0.9, 0.6] + [0.3] * 8)
    right = -(np.log(0.9) + np.log(0.6)) * 0.8
    wrong = -8 * np.log(0.7) * 0.2
    expected = (right + wrong) / 10
    assert float(balanced_cross_entropy(probabilities, labels)) == pytest.approx(expected)
    assert balanced_cross_entropy(labels.float(), labels) == 0
    assert balanced_cross_entropy((~labels).float(), labels) > 10


def test_a_few_steps_lower_the_loss_and_the_method_takes_the_weights(tmp_path):
    learner = trainee()
    optimizer = torch.optim.AdamW(learner.network.parameters(), learner.learning_rate)
    random, seen = np.random.default_rng(0), []
    for _ in range(8):
        optimizer.zero_grad()
        losses = learner.losses(learner.prepare(training_pair(), random))
        sum(losses.values()).backward()
        optimizer.step()
        seen.append(float(losses["descriptor"].detach()))
    assert np.mean(seen[-3:]) < 0.9 * np.mean(seen[:2])
    path = tmp_path / "predator.pth"
    torch.save({"state_dict": learner.network.state_dict()}, path)
    config = RegistrationConfig(method="predator", predator={**SETTINGS, "weights": str(path)})
    method = load_method(config)
    example = training_pair()
    clouds = (example.source, example.target)
    fragments = (Fragment(FragmentId("1", 1, n), cloud, True) for n, cloud in enumerate(clouds))
    assert len(method._matches(*(method.prepare(each) for each in fragments)).source) > 20
