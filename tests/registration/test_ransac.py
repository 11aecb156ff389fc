import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nss_ros.geometry import from_rotation, from_yaw, inverse, rotation_angle, transform_points
from nss_ros.registration.fgr import fast_global_registration
from nss_ros.registration.ransac import Matches, fit, inlier_mask, ransac


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def matches_with_outliers(transform, count, right, random, noise=0.0):
    source = random.uniform(-4, 4, (count, 3))
    normals = unit(random.normal(size=(count, 3)))
    target = transform_points(transform, source) + random.normal(0, noise, source.shape)
    target_normals = normals @ transform[:3, :3].T
    target[right:] = random.uniform(-6, 6, (count - right, 3))
    target_normals[right:] = unit(random.normal(size=(count - right, 3)))
    return Matches(source, target, normals, target_normals)


def error(found, truth):
    difference = inverse(truth) @ found
    return np.linalg.norm(difference[:3, 3]), rotation_angle(difference)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_the_transform_is_found_among_nine_of_ten_wrong_matches(seed):
    random = np.random.default_rng(seed)
    truth = from_rotation(Rotation.random(rng=random), random.uniform(-3, 3, 3))
    matches = matches_with_outliers(truth, 400, 40, random, noise=0.01)
    best = ransac(matches, 0.1, 500_000, 0.999, seed)[0]
    translation, rotation = error(best.T_target_source, truth)
    assert translation < 0.1
    assert rotation < 0.05
    assert best.inliers >= 36


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_levelled_fragments_need_one_right_match_in_fifty(seed):
    random = np.random.default_rng(seed)
    truth = from_yaw(random.uniform(-3, 3), random.uniform(-3, 3, 3))
    matches = matches_with_outliers(truth, 1000, 20, random, noise=0.01)
    best = ransac(matches, 0.1, 100_000, 0.999, seed, level=True)[0]
    translation, rotation = error(best.T_target_source, truth)
    assert translation < 0.1
    assert rotation < 0.05
    assert abs(best.T_target_source[2, 2] - 1) < 1e-12


def test_a_seed_gives_the_same_bytes():
    random = np.random.default_rng(3)
    matches = matches_with_outliers(from_yaw(1.0, (1, 2, 0)), 300, 30, random)
    runs = [ransac(matches, 0.1, 50_000, 0.999, 5, count=4) for _ in range(2)]
    assert [c.T_target_source.tobytes() for c in runs[0]] == [
        c.T_target_source.tobytes() for c in runs[1]
    ]


def test_hypotheses_are_distinct_and_sorted():
    random = np.random.default_rng(1)
    one = matches_with_outliers(from_yaw(1.0, (1, 2, 0)), 200, 100, random)
    other = matches_with_outliers(from_yaw(-2.0, (0, 1, 1)), 200, 60, random)
    both = Matches(*(np.vstack(parts) for parts in zip(fields(one), fields(other), strict=True)))
    found = ransac(both, 0.1, 100_000, 0.99999, 0, count=2)
    assert error(found[0].T_target_source, from_yaw(1.0, (1, 2, 0)))[0] < 0.05
    assert error(found[1].T_target_source, from_yaw(-2.0, (0, 1, 1)))[0] < 0.05
    assert found[0].inliers >= 100 > found[1].inliers >= 60


def fields(matches):
    return matches.source, matches.target, matches.source_normals, matches.target_normals


def few(source):
    normals = np.tile((0.0, 0.0, 1.0), (len(source), 1))
    return Matches(source, source, normals, normals)


@pytest.mark.parametrize("level", [False, True])
@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((2, 3)), np.ones((50, 3))],
    ids=["none", "one", "two", "equal"],
)
def test_nothing_is_found_where_nothing_is_rigid(points, level):
    assert ransac(few(points), 0.1, 1000, 0.999, 0, level) == []
    assert fast_global_registration(few(points), 0.1, 64, 0) is None


def test_collinear_matches_give_finite_transforms_only():
    line = np.linspace(0, 5, 50)[:, None] * np.array([[1.0, 0.5, 0.2]])
    for candidate in ransac(few(line), 0.1, 20_000, 0.999, 0, count=3):
        assert np.isfinite(candidate.T_target_source).all()


def test_inliers_agree_in_position_and_normal():
    points, normals = np.zeros((3, 3)), np.tile((0.0, 0.0, 1.0), (3, 1))
    target = np.array(((0, 0, 0), (0.2, 0, 0), (0, 0, 0)))
    turned = normals * ((1,), (1,), (-1,))
    matches = Matches(points, target, normals, turned)
    assert inlier_mask(matches, np.eye(4), 0.1).tolist() == [True, False, False]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_least_squares_is_exact_without_noise(seed, level):
    random = np.random.default_rng(seed)
    turn = Rotation.from_euler("z", 2.0) if level else Rotation.random(rng=random)
    truth = from_rotation(turn, random.uniform(-3, 3, 3))
    source = random.normal(size=(5, 3))
    assert np.allclose(fit(source, transform_points(truth, source), level), truth, atol=1e-9)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 10_000))
def test_fast_global_registration_with_eight_of_ten_wrong_matches(seed):
    random = np.random.default_rng(seed)
    truth = from_rotation(Rotation.random(rng=random), random.uniform(-3, 3, 3))
    matches = matches_with_outliers(truth, 400, 80, random, noise=0.01)
    found = fast_global_registration(matches, 0.1, 64, seed)
    assert found is not None
    translation, rotation = error(found, truth)
    assert translation < 0.2
    assert rotation < 0.05
    again = fast_global_registration(matches, 0.1, 64, seed)
    assert found.tobytes() == again.tobytes()
