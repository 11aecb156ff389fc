import numpy as np
import torch

from nss_ros.registration.learned.point_matching import matched_points


def test_points_match_that_are_among_each_others_three_best_and_sure():
    random = np.random.default_rng(0)
    assignment = random.dirichlet(np.full(12, 0.3), (4, 10))
    rows, columns = random.uniform(size=(4, 10)) > 0.2, random.uniform(size=(4, 12)) > 0.2
    found = matched_points(*(torch.from_numpy(each) for each in (assignment, rows, columns)))
    expected = np.zeros_like(found)
    for patch, row, column in np.ndindex(expected.shape):
        value = assignment[patch, row, column]
        expected[patch, row, column] = (
            rows[patch, row]
            and columns[patch, column]
            and value > 0.05
            and (assignment[patch, row] > value).sum() < 3
            and (assignment[patch, :, column] > value).sum() < 3
        )
    assert np.array_equal(found, expected)
    assert 0 < expected.sum() < (assignment > 0.05).sum()
