import numpy as np
import pytest
import torch
from furnished_room import room

from nss_ros.config import RegistrationConfig, TrainingConfig
from nss_ros.geometry import from_yaw, inverse, transform_points
from nss_ros.registration.learned.res_unet import Pyramid
from nss_ros.registration.learned.sparse_convolution import Voxels
from nss_ros.registration.learned.training.example import Example, augmented
from nss_ros.registration.learned.training.fcgf import (
    FcgfTrainee,
    hardest_negative,
    positive_loss,
)

CONFIG = RegistrationConfig(fcgf={"voxel_size": 0.2})
TRUTH = from_yaw(0.4, (0.6, -0.3, 0.0))


def trainee():
    torch.manual_seed(0)
    return FcgfTrainee(CONFIG, torch.device("cpu"))


def example():
    """Three quarters each of a room in two scans."""
    source, target = room(1), room(2)
    source = transform_points(inverse(TRUTH), source[source[:, 0] < 1.3]).astype(np.float32)
    return Example(source, target[target[:, 0] > -1.3], TRUTH)


def prepared(learner, seed=0):
    found = learner.prepare(example(), np.random.default_rng(seed))
    assert found is not None
    return found


def test_what_is_drawn_depends_on_the_generator_alone():
    learner = trainee()
    one, same, other = prepared(learner), prepared(learner), prepared(learner, 1)
    assert np.array_equal(one.positives, same.positives)
    assert np.array_equal(one.candidates, same.candidates)
    assert not np.array_equal(one.positives, other.positives)


def test_positives_lie_on_each_other_and_candidates_in_the_right_cloud():
    pair = prepared(trainee())
    apart = pair.positions[pair.positives[:, 0]] - pair.positions[pair.positives[:, 1]]
    assert np.linalg.norm(apart, axis=1).max() <= 1.5 + 1e-4
    first = int(pair.positives[:, 1].min())
    of_source, of_target = pair.candidates
    assert pair.positives[:, 0].max() < first
    assert of_source.max() < first <= of_target.min()


def test_a_pair_without_anything_in_common_is_left_out():
    source = example().source
    far = Example(source, source, from_yaw(0, (50.0, 0, 0)))
    assert trainee().prepare(far, np.random.default_rng(0)) is None


def test_clouds_that_are_described_at_once_do_not_see_each_other():
    learner = trainee()
    network = learner.network.eval()
    pair = prepared(learner)
    count = int(pair.positives[:, 1].min())

    def described(coordinates):
        voxels = Voxels(torch.from_numpy(coordinates))
        with torch.inference_mode():
            return network(torch.ones(len(voxels), 1), Pyramid.of(voxels, network.first_size))

    both = described(pair.coordinates)
    lengths = {count, len(both) - count}
    found = False
    for first in lengths:
        alone = described(pair.coordinates[:first])
        found |= bool((both[:first] - alone).abs().max() < 1e-5)
    assert found


def test_ideal_descriptors_have_no_loss():
    described = torch.eye(4)
    rows = torch.arange(4)
    assert positive_loss(described, described) == 0
    assert positive_loss(described, described.roll(1, 0)) == pytest.approx((2**0.5 - 0.1) ** 2)
    positions = 10 * torch.arange(4.0)[:, None].expand(4, 3)
    assert hardest_negative(described, positions, rows, rows) == 0  # 1.414 apart: beyond 1.4


def test_the_hardest_negative_is_the_nearest_descriptor_of_another_place():
    random = torch.Generator().manual_seed(0)
    described = torch.nn.functional.normalize(torch.randn(40, 5, generator=random))
    positions = 4 * torch.rand(40, 3, generator=random)
    anchors, candidates = torch.arange(20), torch.arange(20, 40)
    expected = []
    for anchor in anchors:
        apart = [
            float((described[anchor] - described[each]).norm())
            for each in candidates
            if (positions[anchor] - positions[each]).norm() > 1.5
        ]
        expected.append(max(1.4 - min(apart), 0) ** 2)
    found = hardest_negative(described, positions, anchors, candidates)
    assert float(found) == pytest.approx(np.mean(expected), rel=1e-5)


def test_an_anchor_that_has_no_negative_costs_nothing():
    described, positions = torch.eye(3), torch.zeros(3, 3)
    rows = torch.arange(3)
    assert hardest_negative(described, positions, rows, rows) == 0


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
    for _ in range(25):
        turned = augmented(example(), TrainingConfig(), random)
        optimizer.zero_grad()
        loss = sum(learner.losses(learner.prepare(turned, random)).values())
        loss.backward()
        optimizer.step()
        seen.append(float(loss.detach()))
    assert np.mean(seen[-3:]) < 0.85 * np.mean(seen[:3])
