"""The second look of the gravity method at poses."""

import math

import numpy as np
import pytest
import torch

from nss_ros.geometry import from_yaw, inverse
from nss_ros.registration.gravity.comparison import Comparison, compared, swapped
from nss_ros.registration.gravity.comparison_training import PosedPair, train_comparison
from nss_ros.registration.gravity.correlation import planar, rotated
from nss_ros.registration.gravity.network import CHANNELS
from nss_ros.registration.gravity.search import Peak

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


def peak(transform):
    yaw = math.atan2(transform[1, 0], transform[0, 0])
    return Peak(yaw, transform[0, 3], transform[1, 3], 0.0, 0.0)


def pair(rng):
    """The source is the target as it is seen from elsewhere; the third pose tells from where."""
    poses, target = transforms(rng, 4), features(rng)
    source = rotated(target, *planar(inverse(poses[2])[None]))[0]
    maps = (source.half().numpy(), target.half().numpy())
    return PosedPair.of(maps, [peak(each) for each in poses], poses[2])


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


def test_swapped_poses_are_inverse():
    poses = transforms(np.random.default_rng(5), 20)
    expected = planar(np.array([inverse(each) for each in poses]))
    for one, other in zip(swapped(*planar(poses)), expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_training_tells_poses_that_it_was_not_shown():
    rng = np.random.default_rng(2)
    shown, others = [pair(rng) for _ in range(24)], [pair(rng) for _ in range(24)]
    comparison = Comparison()
    losses = [loss for _, loss in train_comparison(comparison, shown, 60, 0)]
    assert np.mean(losses[-10:]) < np.mean(losses[:10])
    hits = []
    for each in others:
        source, target = (torch.from_numpy(maps).float() for maps in each.maps)
        poses = torch.from_numpy(each.poses)
        looks = compared(comparison, source, target, poses[:, 0], poses[:, 1:3])
        hits.append(int(looks.argmax()) == 2)
    # A quarter of them by chance.
    assert np.mean(hits) > 0.6


def test_poses_are_right_wrong_or_neither():
    truth = from_yaw(3.1, (1.0, -2.0, 0.7))
    off = [(0.05, 0.1), (0.1, 0.0), (0.0, 0.3), (0.0, 0.6), (0.3, 0.0), (math.pi, 0.0)]
    poses = [from_yaw(3.1 + yaw, (1.0, -2.0 + y, 0.0)) for yaw, y in off]
    maps = (np.zeros((CHANNELS, 2, 2), dtype=np.float16),) * 2
    found = PosedPair.of(maps, [peak(each) for each in poses], truth)
    assert found.right.tolist() == [True, False, False, False, False, False]
    assert found.wrong.tolist() == [False, False, False, True, True, True]
    assert found.is_clear
    assert not PosedPair.of(maps, [peak(each) for each in poses[1:]], truth).is_clear
    apart = PosedPair.of(maps, [peak(each) for each in poses], None)
    assert apart.wrong.all()
    assert apart.is_clear


def test_a_pair_with_nothing_wrong_or_nothing_right_is_trained_on():
    rng = np.random.default_rng(6)
    one, other = pair(rng), pair(rng)
    poses = [peak(each) for each in transforms(rng, 3)]
    apart = PosedPair.of(other.maps, poses, None)
    truth = from_yaw(0.2, (0.5, 0.0, 0.0))
    right = PosedPair.of(one.maps, [peak(truth)], truth)
    steps = list(train_comparison(Comparison(), [apart, right], 3, 0))
    assert [number for number, _ in steps] == [0, 1, 2]
    assert np.isfinite([loss for _, loss in steps]).all()


def test_without_usual_maps_there_is_nothing_to_train():
    comparison = Comparison().eval()
    before = [each.clone() for each in comparison.parameters()]
    assert not list(train_comparison(comparison, [], 3, 0))
    assert all(torch.equal(*each) for each in zip(before, comparison.parameters(), strict=True))
