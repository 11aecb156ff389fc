"""The second look of the gravity method at aligned poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nss_ros.geometry import from_yaw, inverse
from nss_ros.registration.gravity.comparison import Comparison, compared
from nss_ros.registration.gravity.comparison_training import train_comparison, with_looks
from nss_ros.registration.gravity.correlation import planar, rotated
from nss_ros.registration.gravity.network import CHANNELS
from nss_ros.registration.gravity.refinement import COMPARISON_SIGNS, SIGNS
from nss_ros.registration.gravity.verifier_training import Case

CELLS = 48


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)
    torch.set_num_threads(1)


def features(rng):
    """A map of a few things that stand about."""
    maps = np.zeros((CHANNELS, CELLS, CELLS), dtype=np.float32)
    for _ in range(40):
        row, column = rng.integers(10, CELLS - 14, 2)
        maps[rng.integers(CHANNELS), row : row + 4, column : column + 4] = rng.normal()
    return torch.from_numpy(maps)


def transforms(rng, count):
    return np.array(
        [
            from_yaw(rng.uniform(-math.pi, math.pi), (*rng.uniform(-1, 1, 2), 0))
            for _ in range(count)
        ]
    )


def case(rng):
    """The source is the target as it is seen from elsewhere; the first pose tells from where."""
    poses, target = transforms(rng, 4), features(rng)
    source = rotated(target, *planar(np.array([inverse(poses[0])])))[0]
    maps = (source.half().numpy(), target.half().numpy())
    signs = rng.normal(size=(4, len(SIGNS)))
    signs[:, COMPARISON_SIGNS] = 0
    return Case(signs, 0, True, True, poses, maps)


def test_both_fragments_may_be_the_source():
    rng = np.random.default_rng(1)
    one, other, poses = features(rng), features(rng), transforms(rng, 3)
    back = np.array([inverse(each) for each in poses])
    comparison = Comparison().eval()
    forth = compared(comparison, one, other, *planar(poses))
    torch.testing.assert_close(
        forth, compared(comparison, other, one, *planar(back)), atol=1e-5, rtol=1e-4
    )
    assert forth.std() > 0


def test_training_tells_poses_that_it_was_not_shown():
    rng = np.random.default_rng(2)
    shown, others = [case(rng) for _ in range(24)], [case(rng) for _ in range(24)]
    comparison = Comparison()
    losses = [loss for _, loss in train_comparison(comparison, shown, 60, 0)]
    assert np.mean(losses[-10:]) < np.mean(losses[:10])
    looks = np.array(
        [each.signs[:, COMPARISON_SIGNS[0]] for each in with_looks(others, comparison)]
    )
    # A quarter of them by chance.
    assert (looks.argmax(axis=1) == 0).mean() > 0.6


def test_looks_are_signs_and_the_best_has_no_margin():
    rng = np.random.default_rng(3)
    cases = [case(rng) for _ in range(2)]
    for before, after in zip(cases, with_looks(cases, Comparison().eval()), strict=True):
        look, margin = after.signs[:, COMPARISON_SIGNS].T
        assert margin == pytest.approx(look - look.max())
        assert margin.max() == 0
        rest = np.setdiff1d(np.arange(len(SIGNS)), COMPARISON_SIGNS)
        assert np.array_equal(before.signs[:, rest], after.signs[:, rest])


def test_pairs_with_wide_maps_are_not_looked_at():
    rng = np.random.default_rng(4)
    usual = case(rng)
    maps = usual.maps[0], np.zeros((CHANNELS, 120, 120), dtype=np.float16)
    wide = replace(usual, maps=maps)
    comparison = Comparison().eval()
    before = [each.clone() for each in comparison.parameters()]
    assert not list(train_comparison(comparison, [wide], 3, 0))
    assert all(torch.equal(*each) for each in zip(before, comparison.parameters(), strict=True))
    assert with_looks([wide], comparison)[0] is wide
