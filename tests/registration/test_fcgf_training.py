import numpy as np
import pytest
import torch
from training_pair import distant_pair, training_pair

from nss_ros.config import RegistrationConfig, TrainingConfig
from nss_ros.registration.learned.fcgf import one_per_voxel
from nss_ros.registration.learned.res_unet import Pyramid
from nss_ros.registration.learned.sparse_convolution import Voxels
from nss_ros.registration.learned.training.example import augmented
from nss_ros.registration.learned.training.fcgf import (
    FcgfTrainee,
    confusion,
)

CONFIG = RegistrationConfig(fcgf={"voxel_size": 0.2})


def trainee():
    torch.set_num_threads(1)  # as in training
    torch.manual_seed(0)
    return FcgfTrainee(CONFIG, torch.device("cpu"))


def prepared(learner, seed=0):
    found = learner.prepare(training_pair(), np.random.default_rng(seed))
    assert found is not None
    return found


def test_what_is_drawn_depends_on_the_generator_alone():
    learner = trainee()
    one, same, other = prepared(learner), prepared(learner), prepared(learner, 1)
    assert np.array_equal(one.positives, same.positives)
    assert not np.array_equal(one.positives, other.positives)


def test_positives_lie_on_each_other():
    pair = prepared(trainee())
    apart = pair.positions[pair.positives[:, 0]] - pair.positions[pair.positives[:, 1]]
    assert np.linalg.norm(apart, axis=1).max() <= 1.5 + 1e-4
    assert pair.positives[:, 0].max() < pair.positives[:, 1].min()


def test_a_pair_without_anything_in_common_is_left_out():
    assert trainee().prepare(distant_pair(), np.random.default_rng(0)) is None


def test_clouds_that_are_described_at_once_do_not_see_each_other():
    learner = trainee()
    network = learner.network.eval()
    pair = prepared(learner)
    count = len(one_per_voxel(training_pair().source, 0.2)[0])

    def described(coordinates):
        voxels = Voxels(torch.from_numpy(coordinates))
        with torch.inference_mode():
            return network(torch.ones(len(voxels), 1), Pyramid.of(voxels, network.first_size))

    both = described(pair.coordinates)
    both, alone = described(pair.coordinates), described(pair.coordinates[:count])
    assert 0 < count < len(both)
    assert (both[:count] - alone).abs().max() < 1e-5


def test_ideal_descriptors_cost_nothing_and_mixed_up_ones_much():
    similarities, nothing = torch.eye(6), torch.zeros(6, 6, dtype=torch.bool)
    assert confusion(similarities, nothing) < 1e-6
    assert confusion(similarities.roll(1, 0), nothing) > 15
    assert confusion(torch.zeros(6, 6), nothing) == pytest.approx(np.log(6))


def test_confusion_is_the_share_of_the_positive_among_points_of_other_places():
    random = torch.Generator().manual_seed(0)
    similarities = 2 * torch.rand(20, 20, generator=random) - 1
    near = torch.rand(20, 20, generator=random) < 0.3
    expected = []
    for row in range(20):
        weights = [
            np.exp(float(similarities[row, column]) / 0.05)
            for column in range(20)
            if column == row or not near[row, column]
        ]
        expected.append(-np.log(np.exp(float(similarities[row, row]) / 0.05) / np.sum(weights)))
    assert float(confusion(similarities, near)) == pytest.approx(np.mean(expected), rel=1e-5)


def test_points_that_all_lie_in_one_place_cost_nothing():
    assert confusion(torch.zeros(5, 5), torch.ones(5, 5, dtype=torch.bool)) == 0


def test_gradients_reach_all_parameters():
    learner = trainee()
    sum(learner.losses(prepared(learner)).values()).backward()
    for name, parameter in learner.network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


def test_a_few_steps_lower_the_loss():
    learner = trainee()
    optimizer = torch.optim.AdamW(learner.network.parameters(), learner.learning_rate)
    random = np.random.default_rng(0)
    seen = []
    for _ in range(12):
        turned = augmented(training_pair(), TrainingConfig(), random)
        optimizer.zero_grad()
        loss = sum(learner.losses(learner.prepare(turned, random)).values())
        loss.backward()
        optimizer.step()
        seen.append(float(loss.detach()))
    assert np.mean(seen[-3:]) < 0.95 * np.mean(seen[:2])
