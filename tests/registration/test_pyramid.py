import numpy as np
import pytest
import torch

from nss_ros.registration.learned.pyramid import grid_subsampled, pyramid, radius_neighbours


def cloud(count, seed=0, size=1.0):
    return np.random.default_rng(seed).uniform(-size, size, (count, 3)).astype(np.float32)


def test_a_grid_against_a_dictionary_of_voxels():
    points = cloud(2000)
    voxels = {}
    origin = np.floor(points.min(axis=0) / 0.2) * 0.2
    for point in points:
        voxels.setdefault(tuple(np.floor((point - origin) / 0.2).astype(int)), []).append(point)
    means = np.array([np.mean(each, axis=0) for each in voxels.values()])
    found = grid_subsampled(points, 0.2)
    assert found.dtype == np.float32
    assert np.allclose(sorted(found.tolist()), sorted(means.tolist()), atol=1e-6)


def test_a_grid_is_ordered_by_z_then_y_then_x():
    found = grid_subsampled(cloud(3000), 0.25)
    cells = np.floor(found / 0.25)
    assert np.array_equal(np.lexsort(cells.T), np.arange(len(cells)))


def test_a_grid_moves_with_the_cloud_by_whole_voxels():
    points = np.round(cloud(500) * 64) / 64
    moved = points + np.array([0.5, -1.0, 2.0], dtype=np.float32)
    expected = grid_subsampled(points, 0.25) + np.array([0.5, -1.0, 2.0])
    assert np.allclose(grid_subsampled(moved, 0.25), expected, atol=1e-6)


@pytest.mark.parametrize("points", [np.zeros((0, 3), np.float32), np.ones((7, 3), np.float32)])
def test_a_grid_of_no_point_or_one(points):
    assert np.array_equal(grid_subsampled(points, 0.1), points[:1])


@pytest.mark.parametrize("limit", [1, 9, 1000])
def test_neighbours_against_all_distances(limit):
    queries, supports = cloud(100, 1), cloud(400, 2)
    distances = np.linalg.norm(queries[:, None].astype(np.float64) - supports, axis=2)
    found = radius_neighbours(queries, supports, 0.4, limit)
    counts = np.minimum((distances < 0.4).sum(axis=1), limit)
    assert found.shape == (100, max(counts.max(), 1))
    for row, near, count in zip(distances, found, counts, strict=True):
        assert np.array_equal(near[:count], np.argsort(row)[:count])
        assert (near[count:] == len(supports)).all()


def test_neighbours_where_there_is_none():
    found = radius_neighbours(cloud(5), cloud(8) + 100, 0.5, 10)
    assert np.array_equal(found, np.full((5, 1), 8))


def test_two_clouds_are_no_neighbours():
    clouds = [grid_subsampled(cloud(3000, seed), 0.1) for seed in (0, 1)]
    levels = pyramid(clouds, 0.1, 0.25, [30, 30, 30], torch.device("cpu"))
    alone = [pyramid([each], 0.1, 0.25, [30, 30, 30], torch.device("cpu")) for each in clouds]
    for level, *single in zip(levels, *alone, strict=True):
        assert level.lengths == tuple(len(each.points) for each in single)
        assert torch.equal(level.points, torch.cat([each.points for each in single]))
        split = level.lengths[0]
        near = level.neighbours[split:] - split
        other = single[1].neighbours
        assert torch.equal(near[:, : other.shape[1]], other)
        assert (near[:, other.shape[1] :] == single[1].lengths[0]).all()
        assert (
            (level.neighbours[:split] < split) | (level.neighbours[:split] == sum(level.lengths))
        ).all()


def test_levels_refer_to_each_other():
    points = grid_subsampled(cloud(6000), 0.1)
    fine, middle, coarse = pyramid([points], 0.1, 0.25, [20, 25, 30], torch.device("cpu"))
    assert np.array_equal(fine.points, points)
    assert np.array_equal(middle.points, grid_subsampled(points, 0.2))
    assert np.array_equal(coarse.points, grid_subsampled(middle.points.numpy(), 0.4))
    assert coarse.pooling is None
    assert coarse.upsampling is None
    for level, below, radius, limit in ((fine, middle, 0.25, 20), (middle, coarse, 0.5, 25)):
        pooled = radius_neighbours(below.points.numpy(), level.points.numpy(), radius, limit)
        assert np.array_equal(level.pooling, pooled)
        distances = torch.cdist(level.points.double(), below.points.double())
        assert torch.equal(level.upsampling, distances.argmin(dim=1))
    assert np.array_equal(
        coarse.neighbours, radius_neighbours(coarse.points, coarse.points, 1.0, 30)
    )
