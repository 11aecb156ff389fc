import numpy as np
import pytest
import torch
from training_pair import distant_pair, training_pair

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.registration.learned.training.d3feat import D3FeatTrainee, detector_loss
from nss_ros.registration.method import load_method

SETTINGS = {"voxel_size": 0.2}


def trainee():
    torch.set_num_threads(1)  # as in training
    torch.manual_seed(0)
    return D3FeatTrainee(RegistrationConfig(d3feat=SETTINGS), torch.device("cpu"))


def test_gradients_reach_all_that_learns():
    learner = trainee()
    learner.network.train()
    losses = learner.losses(learner.prepare(training_pair(), np.random.default_rng(0)))
    assert set(losses) == {"descriptor", "detector"}
    sum(losses.values()).backward()
    for name, parameter in learner.network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


def test_a_pair_without_anything_in_common_is_left_out():
    assert trainee().prepare(distant_pair(), np.random.default_rng(0)) is None


def test_detection_is_to_be_where_descriptors_tell_places_apart():
    apart = torch.full((4, 4), 9.0).fill_diagonal_(0)
    apart[0, 1] = 2.0  # near in truth: no negative of the first
    described = torch.tensor(
        [[0.2, 0.1, 0.9, 1.2], [1.0, 0.3, 1.1, 0.8], [0.5, 0.6, 0.9, 0.7], [1, 1, 1, 0.4]]
    )
    scores = torch.tensor([1.0, 0.5, 2.0, 0.0])
    expected = ((0.2 - 0.9) * 1 + (0.3 - 0.8) * 0.5 + (0.9 - 0.5) * 2) / 4
    assert float(detector_loss(described, apart, scores)) == pytest.approx(expected)
    assert detector_loss(described, torch.zeros(4, 4), scores) == 0


def test_scores_are_soft_in_training_only():
    learner = trainee()
    pair = learner.prepare(training_pair(), np.random.default_rng(0))
    with torch.no_grad():
        soft = learner.network.train()(pair.source)[1]
        hard = learner.network.eval()(pair.source)[1]
    assert (soft > 0).all()
    assert (hard == 0).any()
    assert torch.equal(hard[hard > 0], soft[hard > 0])


def test_a_few_steps_lower_the_loss_and_the_method_takes_the_weights(tmp_path):
    learner = trainee()
    learner.network.train()
    optimizer = torch.optim.AdamW(learner.network.parameters(), learner.learning_rate)
    random, seen = np.random.default_rng(0), []
    for _ in range(8):
        optimizer.zero_grad()
        losses = learner.losses(learner.prepare(training_pair(), random))
        sum(losses.values()).backward()
        optimizer.step()
        seen.append(float(losses["descriptor"].detach()))
    assert np.mean(seen[-3:]) < 0.9 * np.mean(seen[:2])
    path = tmp_path / "d3feat.pth"
    torch.save({"state_dict": learner.network.state_dict()}, path)
    config = RegistrationConfig(method="d3feat", d3feat={**SETTINGS, "weights": str(path)})
    described = (
        load_method(config)
        .prepare(Fragment(FragmentId("1", 1, 1), training_pair().source, True))
        .described
    )
    assert len(described.points) > 100
    assert np.isfinite(described.descriptors).all()
