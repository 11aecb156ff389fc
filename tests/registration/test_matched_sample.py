import numpy as np
from training_pair import TRUTH, distant_pair, training_pair

from nss_ros.geometry import transform_points
from nss_ros.registration.learned.training.example import Example
from nss_ros.registration.learned.training.matched_sample import matched_sample


def drawn(example, count=100, seed=0):
    random = np.random.default_rng(seed)
    source, target = example.source, example.target
    return matched_sample(source, target, example.T_target_source, 0.1, 1.5, count, random)


def test_correspondences_lie_on_each_other_and_sources_are_drawn_once():
    example = training_pair()
    sample = drawn(example)
    assert len(sample.source) == len(sample.target) == len(set(sample.source.tolist())) == 100
    moved = transform_points(TRUTH, example.source)[sample.source]
    assert np.linalg.norm(moved - example.target[sample.target], axis=1).max() <= 0.15


def test_the_overlap_is_all_that_has_a_neighbour_in_the_other_cloud():
    example = training_pair()
    example = Example(example.source[::5], example.target[::5], TRUTH)
    sample = drawn(example)
    moved = transform_points(TRUTH, example.source)
    near = np.linalg.norm(moved[:, None] - example.target, axis=2) <= 0.15
    assert np.array_equal(sample.overlap, np.concatenate((near.any(axis=1), near.any(axis=0))))
    assert 0.1 < sample.overlap.mean() < 0.95


def test_positions_are_true_places_in_voxels():
    example = training_pair()
    expected = np.concatenate((transform_points(TRUTH, example.source), example.target)) / 0.1
    assert np.allclose(drawn(example).positions, expected, atol=1e-4)


def test_the_generator_decides_what_is_drawn():
    example = training_pair()
    assert np.array_equal(drawn(example).source, drawn(example).source)
    assert not np.array_equal(drawn(example).source, drawn(example, seed=1).source)


def test_too_little_in_common_gives_nothing():
    assert drawn(distant_pair()) is None
