import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from nss_ros.dataset.overlap import Cloud, all_overlaps, overlap_of_at_least, pair_overlap
from nss_ros.errors import InputError
from nss_ros.geometry import exponential, inverse, relative, transform_points

seeds = st.integers(0, 2**32 - 1)


def random_pair(seed, count=120):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-1, 1, (count, 3)) * (1.0, 0.8, 0.6)
    target = rng.uniform(-1, 1, (count + 30, 3)) * (0.9, 1.0, 0.5) + rng.uniform(-0.8, 0.8, 3)
    return source, target, exponential(rng.normal(0.0, 0.3, 6))


def brute_force(source, target, T_target_source, tau):
    moved = transform_points(T_target_source, source)
    distances = np.linalg.norm(moved[:, None] - target[None], axis=2)
    source_met, target_met = (distances <= tau).any(axis=1), (distances <= tau).any(axis=0)

    def inside(points, hull_points):
        planes = ConvexHull(hull_points).equations
        return (points @ planes[:, :3].T + planes[:, 3] <= 1e-9).all(axis=1)

    shared = np.concatenate((source_met[inside(moved, target)], target_met[inside(target, moved)]))
    return source_met.mean(), 1 - shared.mean() if len(shared) else np.nan


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(0.05, 0.4))
def test_both_ratios_equal_brute_force(seed, tau):
    source, target, T_target_source = random_pair(seed)
    figures = pair_overlap(Cloud(source), Cloud(target), T_target_source, tau)
    overlap_ratio, temporal_change = brute_force(source, target, T_target_source, tau)
    assert figures.overlap_ratio == pytest.approx(overlap_ratio, abs=1e-12)
    assert figures.temporal_change == pytest.approx(temporal_change, abs=1e-12, nan_ok=True)


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_a_common_rigid_motion_changes_nothing(seed):
    source, target, T_target_source = random_pair(seed)
    move_source, move_target = exponential([3, 1, -2, 1, 0.5, 2]), exponential([0, 9, 1, -1, 2, 0])
    before = pair_overlap(Cloud(source), Cloud(target), T_target_source)
    after = pair_overlap(
        Cloud(transform_points(move_source, source)),
        Cloud(transform_points(move_target, target)),
        move_target @ T_target_source @ inverse(move_source),
    )
    assert after.overlap_ratio == pytest.approx(before.overlap_ratio, abs=1e-12)
    assert after.temporal_change == pytest.approx(before.temporal_change, abs=1e-12, nan_ok=True)


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_temporal_change_does_not_depend_on_the_direction(seed):
    source, target, T_target_source = random_pair(seed)
    forth = pair_overlap(Cloud(source), Cloud(target), T_target_source)
    back = pair_overlap(Cloud(target), Cloud(source), inverse(T_target_source))
    assert back.temporal_change == pytest.approx(forth.temporal_change, abs=1e-12, nan_ok=True)


def test_a_fragment_overlaps_itself_wholly_and_unchanged():
    points, _, T_target_source = random_pair(3)
    moved = transform_points(T_target_source, points)
    figures = pair_overlap(Cloud(points), Cloud(moved), T_target_source)
    assert (figures.overlap_ratio, figures.temporal_change) == (1.0, 0.0)


def test_tau_itself_counts():
    figures = pair_overlap(
        Cloud(np.zeros((1, 3))), Cloud(np.array([[0.25, 0.0, 0.0]])), np.eye(4), tau=0.25
    )
    assert figures.overlap_ratio == 1.0


@pytest.mark.parametrize("count", [0, 1, 3])
def test_clouds_without_volume_have_no_temporal_change(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    figures = pair_overlap(Cloud(points), Cloud(points), np.eye(4))
    assert figures.overlap_ratio == (1.0 if count else 0.0)
    assert np.isnan(figures.temporal_change)


def test_a_flat_cloud_has_no_hull():
    rng = np.random.default_rng(0)
    flat = np.column_stack((rng.random((50, 2)), np.zeros(50)))
    assert np.isnan(pair_overlap(Cloud(flat), Cloud(flat), np.eye(4)).temporal_change)


def test_all_overlaps_skips_only_pairs_that_cannot_touch():
    rng = np.random.default_rng(5)
    clouds = [Cloud(rng.uniform(-1, 1, (80, 3))) for _ in range(6)]
    poses = [exponential([*rng.uniform(-4, 4, 3), *rng.normal(size=3)]) for _ in clouds]
    overlaps = all_overlaps(clouds, poses)
    every = {(i, j) for i in range(6) for j in range(i + 1, 6)}
    assert set(overlaps) < every
    for i, j in every:
        figures = pair_overlap(clouds[i], clouds[j], relative(poses[i], poses[j]))
        if (i, j) in overlaps:
            assert overlaps[i, j] == figures or np.isnan(figures.temporal_change)
        else:
            assert figures.overlap_ratio == 0


@settings(max_examples=25)
@given(seeds, st.floats(0.05, 0.4))
def test_the_reverse_ratio_is_that_of_the_pair_turned_round(seed, tau):
    source, target, T_target_source = random_pair(seed)
    forth = pair_overlap(Cloud(source), Cloud(target), T_target_source, tau)
    back = pair_overlap(Cloud(target), Cloud(source), inverse(T_target_source), tau)
    assert back.overlap_ratio == forth.reverse_overlap_ratio
    assert back.reverse_overlap_ratio == forth.overlap_ratio
    assert forth.overlap_ratio == brute_force(source, target, T_target_source, tau)[0]


@settings(max_examples=25)
@given(seeds)
def test_neither_the_order_of_the_points_nor_repeating_all_of_them_matters(seed):
    source, target, T_target_source = random_pair(seed)
    before = pair_overlap(Cloud(source), Cloud(target), T_target_source)
    rng = np.random.default_rng(seed)
    mixed = rng.permutation(np.concatenate((source, source))), rng.permutation(target)
    after = pair_overlap(*map(Cloud, mixed), T_target_source)
    assert after.overlap_ratio == before.overlap_ratio
    assert after.reverse_overlap_ratio == before.reverse_overlap_ratio
    alone = pair_overlap(Cloud(rng.permutation(source)), Cloud(mixed[1]), T_target_source)
    assert alone.temporal_change == pytest.approx(before.temporal_change, abs=1e-12, nan_ok=True)
    assert 0 <= before.overlap_ratio <= 1
    assert not before.temporal_change < 0
    assert not before.temporal_change > 1


@settings(max_examples=40)
@given(seeds, st.floats(0.0, 1.0))
def test_only_pairs_below_the_limit_in_both_directions_are_dropped(seed, least):
    source, target, T_target_source = random_pair(seed)
    T_target_source[:3, 3] += 0.8
    figures = pair_overlap(Cloud(source), Cloud(target), T_target_source)
    dropped = overlap_of_at_least(Cloud(source), Cloud(target), T_target_source, least)
    if max(figures.overlap_ratio, figures.reverse_overlap_ratio) >= least:
        assert dropped == figures or np.isnan(figures.temporal_change)
    else:
        assert dropped is None


def test_a_point_far_off_is_measured_without_a_huge_grid():
    source, target, T_target_source = random_pair(1)
    far = np.concatenate((target, [[1e7, 1e7, 1e7]]))
    figures = pair_overlap(Cloud(source), Cloud(far), T_target_source)
    near = pair_overlap(Cloud(source), Cloud(target), T_target_source)
    assert figures.overlap_ratio == near.overlap_ratio
    assert figures.reverse_overlap_ratio == pytest.approx(
        near.reverse_overlap_ratio * len(target) / len(far)
    )


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.array([[0.0, 0.0, np.nan]]), "holds 1 points that are not finite"),
        (np.zeros((4, 2)), r"shape \(n, 3\), not \(4, 2\)"),
    ],
)
def test_what_cannot_be_measured_is_said(points, words):
    with pytest.raises(InputError, match=words):
        Cloud(points)
    with pytest.raises(InputError, match=r"tau must be positive, not 0\.0 m"):
        pair_overlap(Cloud(np.zeros((1, 3))), Cloud(np.zeros((1, 3))), np.eye(4), 0.0)
