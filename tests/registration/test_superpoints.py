import numpy as np
import torch

from nss_ros.registration.learned.superpoints import (
    CORRESPONDENCES,
    PATCH_SIZE,
    matched_superpoints,
    patches,
)


def owned_by_force(points, superpoints):
    """Per superpoint the numbers of its points, nearest first, at most 64."""
    distances = np.linalg.norm(points[:, None] - superpoints, axis=2)
    owners = distances.argmin(axis=1)
    found = []
    for number in range(len(superpoints)):
        mine = np.flatnonzero(owners == number)
        found.append(mine[np.argsort(distances[mine, number])][:PATCH_SIZE].tolist())
    return found


def test_points_belong_to_the_nearest_superpoint():
    random = np.random.default_rng(0)
    points = random.uniform(0, 1, (900, 3)).astype(np.float32)
    superpoints = np.vstack((random.uniform(0, 1, (20, 3)), [[9.0, 9.0, 9.0]])).astype(np.float32)
    found = patches(points, superpoints)
    assert found.shape == (21, PATCH_SIZE)
    expected = owned_by_force(points, superpoints)
    sizes = [len(each) for each in expected]
    assert max(sizes) == PATCH_SIZE
    assert 0 < min(sizes[:20]) < PATCH_SIZE
    assert sizes[20] == 0
    for row, mine in zip(found.tolist(), expected, strict=True):
        assert row == mine + [900] * (PATCH_SIZE - len(mine))


def features(count, seed):
    return torch.nn.functional.normalize(
        torch.randn(count, 8, generator=torch.Generator().manual_seed(seed)), dim=1
    )


def scores_by_force(target, source):
    alike = np.array([[np.exp(-float(((a - b) ** 2).sum())) for b in source] for a in target])
    return alike / alike.sum(axis=1, keepdims=True) * (alike / alike.sum(axis=0, keepdims=True))


def test_superpoints_match_that_are_alike_and_like_few_others():
    target, source = features(30, 0), features(20, 1)
    # The first of the target has no points: it counts for nothing.
    target_mask, source_mask = torch.arange(30) > 0, torch.ones(20, dtype=torch.bool)
    found = matched_superpoints(target, source, target_mask, source_mask)
    scores = scores_by_force(target[1:].double().numpy(), source.double().numpy())
    best = np.argsort(-scores.ravel())[:CORRESPONDENCES]
    assert found.target.tolist() == (best // 20 + 1).tolist()
    assert found.source.tolist() == (best % 20).tolist()


def test_few_superpoints_all_match():
    everything = torch.ones(3, dtype=torch.bool)
    found = matched_superpoints(features(3, 0), features(3, 1), everything, everything)
    assert sorted(zip(found.target.tolist(), found.source.tolist(), strict=True)) == [
        (one, other) for one in range(3) for other in range(3)
    ]
