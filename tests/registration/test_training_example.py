import numpy as np
import pytest
from furnished_room import room
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.config import TrainingConfig
from nss_ros.geometry import from_yaw, inverse, transform_points
from nss_ros.registration.learned.training.example import Example, augmented, correspondences

TRUTH = from_yaw(0.7, (1.0, -2.0, 0.1))


def example():
    target = room(spacing=0.3)
    source = transform_points(inverse(TRUTH), target).astype(np.float32)
    return Example(source, target, TRUTH)


@given(st.integers(0, 1000), st.sampled_from(["level", "any"]))
def test_a_turned_example_keeps_its_truth(seed, rotations):
    config = TrainingConfig(rotations=rotations, noise=0)
    turned = augmented(example(), config, np.random.default_rng(seed))
    assert turned.source.dtype == turned.target.dtype == np.float32
    moved = transform_points(turned.T_target_source, turned.source)
    assert np.abs(moved - turned.target).max() < 1e-4
    assert np.linalg.det(turned.T_target_source[:3, :3]) == pytest.approx(1)
    # Sensors stay where they are.
    assert np.allclose(
        np.linalg.norm(turned.source, axis=1), np.linalg.norm(example().source, axis=1), atol=1e-4
    )


def tilts(rotations):
    """Between the verticals of turned targets and that of the target, degrees."""
    target = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
    config = TrainingConfig(rotations=rotations, noise=0)
    turned = [
        augmented(Example(target, target, np.eye(4)), config, np.random.default_rng(seed)).target[0]
        for seed in range(200)
    ]
    return np.degrees(np.arccos(np.clip(np.array(turned)[:, 2], -1, 1)))


def test_fragments_are_tilted_by_as_much_as_is_asked_for():
    assert 2 < tilts("level").max() <= 3.001
    assert tilts("any").max() > 150


def test_noise_is_as_large_as_is_asked_for():
    config = TrainingConfig(noise=0.02)
    turned = augmented(example(), config, np.random.default_rng(1))
    moved = transform_points(turned.T_target_source, turned.source)
    assert np.std(moved - turned.target) == pytest.approx(0.02 * np.sqrt(2), rel=0.1)


def test_correspondences_are_those_of_all_pairs_within_the_radius():
    random = np.random.default_rng(0)
    source, target = (random.uniform(0, 1, (60, 3)).astype(np.float32) for _ in range(2))
    found = correspondences(source, target, TRUTH, 1.7)
    apart = np.linalg.norm(transform_points(TRUTH, source)[:, None] - target, axis=2)
    assert 0 < len(found) < 3600
    assert {tuple(each) for each in found} == {tuple(each) for each in np.argwhere(apart <= 1.7)}


def test_far_clouds_have_no_correspondences():
    points = np.zeros((3, 3), dtype=np.float32)
    assert correspondences(points, points, from_yaw(0, (9, 0, 0)), 1.0).shape == (0, 2)
