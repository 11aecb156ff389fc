import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nss_ros.geometry import from_rotation, rotation_angle, transform_points
from nss_ros.registration.learned.local_to_global import (
    PatchMatches,
    local_to_global,
    weighted_fit,
)

RADIUS = 0.1


def transform(seed=0):
    random = np.random.default_rng(seed)
    return from_rotation(Rotation.random(rng=random), random.uniform(-2, 2, 3))


def cloud(count, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (count, 3))


def test_a_fit_recovers_a_transform():
    truth, source = transform(), cloud(20)
    weights = np.random.default_rng(1).uniform(0.1, 1, 20)
    target = transform_points(truth, source)
    target[:4] += 1
    weights[:4] = 0
    assert np.allclose(weighted_fit(source, target, weights), truth, atol=1e-4)


def test_weights_count():
    source = np.zeros((2, 3))
    target = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = weighted_fit(source, target, np.array([3.0, 1.0]))
    assert np.allclose(found[:3, 3], (0.25, 0, 0), atol=1e-4)


@pytest.mark.parametrize("flatness", [1.0, 0.0])  # of points on a plane
def test_a_fit_is_never_a_reflection(flatness):
    source = cloud(30) * (1, 1, flatness)
    for target in (source * (1, 1, -1), source * (-1, 1, 1)):
        found = weighted_fit(source, target, np.ones(30))
        assert np.isclose(np.linalg.det(found[:3, :3]), 1)
        assert np.allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_fit_without_weight_is_finite():
    assert np.allclose(weighted_fit(cloud(5), cloud(5, 1), np.zeros(5)), np.eye(4))


def matches_of(patches, noise=0.01):
    """Matches of patches of (transform, count), each of points near each other."""
    random = np.random.default_rng(5)
    source = [random.uniform(-2, 2, 3) + random.uniform(-0.3, 0.3, (n, 3)) for _, n in patches]
    target = [
        transform_points(each, points) + random.normal(0, noise, points.shape)
        for (each, _), points in zip(patches, source, strict=True)
    ]
    source, target = np.vstack(source), np.vstack(target)
    numbers = np.repeat(np.arange(len(patches)) * 2, [n for _, n in patches])
    scores = random.uniform(0.05, 1, len(source))
    return PatchMatches(source, target, source, target, scores, numbers)


def is_near(found, truth):
    return (
        np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 0.05
        and rotation_angle(np.linalg.inv(truth) @ found) < 0.02
    )


def test_the_transform_on_which_most_patches_agree_wins():
    truth = transform(100)
    wrong = [(transform(seed), 25) for seed in range(12)]
    matches = matches_of([*wrong[:6], (truth, 15), (truth, 20), (truth, 15), *wrong[6:]])
    assert is_near(local_to_global(matches, RADIUS), truth)
    everything = weighted_fit(matches.source, matches.target, matches.scores)
    assert not is_near(everything, truth)


def test_the_refined_transform_is_that_of_all_matches_that_agree():
    truth = transform(100)
    patches = [(truth, 10)] * 20 + [(transform(seed), 10) for seed in range(5)]
    matches = matches_of(patches, noise=0.02)
    found = local_to_global(matches, RADIUS)
    right = slice(0, 200)
    best = weighted_fit(matches.source[right], matches.target[right], matches.scores[right])
    assert np.allclose(found, best, atol=2e-3)


@pytest.mark.parametrize(("size", "wins"), [(2, False), (3, True)])
def test_patches_of_two_matches_propose_nothing(size, wins):
    many, one = transform(100), transform(101)
    found = local_to_global(matches_of([(many, size)] * 10 + [(one, 3)], noise=0.0), RADIUS)
    assert is_near(found, many if wins else one)


def test_all_matches_propose_where_no_patch_has_enough():
    truth = transform(100)
    assert is_near(local_to_global(matches_of([(truth, 2)] * 8, noise=0.002), RADIUS), truth)


def test_fewer_than_three_matches_give_no_transform():
    truth = transform()
    assert local_to_global(matches_of([(truth, 2)]), RADIUS) is None
    assert local_to_global(matches_of([(truth, 0)]), RADIUS) is None
    assert local_to_global(matches_of([(truth, 3)]), RADIUS) is not None
