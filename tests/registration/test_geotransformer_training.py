import numpy as np
import pytest
import torch
from training_pair import distant_pair, training_pair

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.registration.learned.training.geotransformer import (
    GeoTransformerTrainee,
    Patches,
    assignment_loss,
    matching,
    patch_overlap,
)
from nss_ros.registration.method import load_method

SETTINGS = {"voxel_size": 0.15}


def trainee():
    torch.set_num_threads(1)  # as in training
    torch.manual_seed(0)
    config = RegistrationConfig(geotransformer=SETTINGS)
    return GeoTransformerTrainee(config, torch.device("cpu"))


def prepared(learner, seed=0):
    return learner.prepare(training_pair(), np.random.default_rng(seed))


def test_gradients_reach_all_that_learns():
    learner = trainee()
    losses = learner.losses(prepared(learner))
    assert set(losses) == {"superpoints", "points"}
    sum(losses.values()).backward()
    # This bias adds the same to all that a softmax compares, and nothing uses it.
    without = {name for name, each in learner.network.named_parameters() if each.grad is None}
    assert all(name.endswith("attention.proj_p.bias") for name in without)
    assert learner.network.transformer.embedding.proj_d.weight.grad.abs().max() > 0
    assert learner.network.transformer.embedding.proj_a.weight.grad.abs().max() > 0


def test_features_are_the_same_with_gradients_and_without():
    learner = trainee()
    levels = prepared(learner).levels
    with torch.inference_mode():
        expected = learner.network.describe(levels)
    found = learner.network.describe(levels)
    for one, other in zip(found, expected, strict=True):
        assert torch.allclose(one.descriptors, other.descriptors, atol=1e-5)


def test_a_pair_without_anything_in_common_is_left_out():
    assert trainee().prepare(distant_pair(), np.random.default_rng(0)) is None


def test_patches_overlap_by_the_mean_share_of_their_points():
    # Target: points 0 1 2 in patch 0, 3 in patch 1, 4 in none. Source: 0 1 in patch 0, 2 in 1.
    target = Patches(np.array([[0, 1, 2], [3, 5, 5]]), 5)
    source = Patches(np.array([[0, 1], [2, 3]]), 3)
    pairs = np.array([[0, 0], [1, 0], [1, 1], [3, 2], [4, 2], [4, 0]])
    expected = [[(2 / 3 + 2 / 2) / 2, 0], [0, (1 / 1 + 1 / 1) / 2]]
    assert np.allclose(patch_overlap(target, source, pairs), expected)
    assert (patch_overlap(target, source, pairs[:0]) == 0).all()


def test_full_patches_have_no_missing_point():
    patches = Patches(np.array([[0, 1], [2, 3]]), 4)
    assert patches.sizes().tolist() == [2, 2]
    assert patches.owners().tolist() == [0, 0, 1, 1]


def test_the_points_that_match_lie_on_each_other():
    learner = trainee()
    pair = prepared(learner)
    target, source = (each for each in learner.network.describe(pair.levels))
    moved = source._replace(points=pair.moved)
    matched = matching(target, moved, pair.rows, pair.columns, 0.3)
    assert matched.any(dim=(1, 2)).all()  # patches that overlap have such points
    for patch, row, column in matched.nonzero()[::97].tolist():
        one = target.points[target.patches[pair.rows[patch], row]]
        other = pair.moved[source.patches[pair.columns[patch], column]]
        assert (one - other).norm() <= 0.3
    assert (pair.overlap[pair.rows, pair.columns] > 0.1).all()


def test_assignments_cost_what_is_not_assigned_to_the_match_or_to_nothing():
    shares = torch.tensor([[[0.7, 0.1, 0.2], [0.2, 0.3, 0.5], [0.1, 0.6, 0.0]]])
    matched = torch.tensor([[[True, False], [False, False]]])
    exists = torch.ones(1, 2, dtype=torch.bool)
    expected = -(np.log(0.7) + np.log(0.5) + np.log(0.6)) / 3
    found = assignment_loss(shares.log(), matched, exists, exists)
    assert float(found) == pytest.approx(expected, rel=1e-5)
    only = torch.tensor([[True, False]])
    found = assignment_loss(shares.log(), matched, only, only)
    assert float(found) == pytest.approx(-np.log(0.7), rel=1e-5)


def test_a_few_steps_lower_the_loss_and_the_method_takes_the_weights(tmp_path):
    learner = trainee()
    optimizer = torch.optim.AdamW(learner.network.parameters(), learner.learning_rate)
    random, seen = np.random.default_rng(0), []
    for _ in range(6):
        optimizer.zero_grad()
        loss = sum(learner.losses(learner.prepare(training_pair(), random)).values())
        loss.backward()
        optimizer.step()
        seen.append(float(loss.detach()))
    assert np.mean(seen[-2:]) < 0.9 * seen[0]
    path = tmp_path / "geotransformer.pth"
    torch.save({"state_dict": learner.network.state_dict()}, path)
    settings = {**SETTINGS, "weights": str(path)}
    method = load_method(RegistrationConfig(method="geotransformer", geotransformer=settings))
    example = training_pair()
    clouds = (example.source, example.target)
    fragments = (Fragment(FragmentId("1", 1, n), cloud, True) for n, cloud in enumerate(clouds))
    matches = method._matches(*(method.prepare(each) for each in fragments))
    assert np.isfinite(matches.source).all()
