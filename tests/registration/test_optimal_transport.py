import numpy as np
import pytest
import torch

from nss_ros.registration.learned.optimal_transport import OptimalTransport


@pytest.fixture(autouse=True)
def _no_gradients():
    torch.manual_seed(0)
    with torch.no_grad():
        yield


def everything(*shape):
    return torch.ones(shape, dtype=torch.bool)


def transport(alpha=0.7):
    network = OptimalTransport()
    network.alpha.fill_(alpha)
    return network


def sinkhorn(scores, alpha):
    """The algorithm as Sinkhorn and Knopp have it, without logarithms, in float64."""
    rows, columns = scores.shape
    kernel = np.full((rows + 1, columns + 1), np.exp(alpha))
    kernel[:-1, :-1] = np.exp(scores)
    row_mass = np.append(np.ones(rows), columns)
    column_mass = np.append(np.ones(columns), rows)
    by_column = np.ones(columns + 1)
    for _ in range(100):
        by_row = row_mass / (kernel @ by_column)
        by_column = column_mass / (by_row @ kernel)
    return by_row[:, None] * kernel * by_column


def test_it_is_sinkhorns_algorithm_with_a_slack():
    scores = 2 * torch.randn(3, 5, 8)
    found = transport()(scores, everything(3, 5), everything(3, 8)).exp()
    assert found.shape == (3, 6, 9)
    for each, mine in zip(found, scores, strict=True):
        assert np.allclose(each, sinkhorn(mine.double().numpy(), 0.7), atol=1e-5)


def test_all_that_exists_is_assigned_once():
    rows, columns = torch.arange(12) < 7, torch.arange(12) < 10
    found = transport()(3 * torch.randn(4, 12, 12), rows.expand(4, -1), columns.expand(4, -1)).exp()
    assert torch.allclose(found[:, :7].sum(dim=2), torch.ones(4, 7), atol=1e-3)
    assert torch.allclose(found[:, :, :10].sum(dim=1), torch.ones(4, 10), atol=1e-4)
    assert torch.allclose(found[:, -1].sum(dim=1), torch.full((4,), 7.0 + 3.0), atol=1e-2)


def test_what_does_not_exist_changes_nothing():
    scores = torch.randn(1, 6, 6)
    rows, columns = (
        torch.tensor([[number not in gone for number in range(6)]]) for gone in ((1,), (0, 5))
    )
    found = transport()(scores, rows, columns).exp()[0]
    assert found[:-1, :-1][~(rows[0][:, None] & columns[0])].max() == 0
    rest = transport()(scores[:, rows[0]][:, :, columns[0]], everything(1, 5), everything(1, 4))
    kept_rows, kept_columns = (
        torch.cat((each[0], torch.tensor([True]))) for each in (rows, columns)
    )
    assert torch.allclose(found[kept_rows][:, kept_columns], rest.exp()[0], atol=1e-5)
