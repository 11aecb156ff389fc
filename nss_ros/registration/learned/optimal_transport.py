"""Soft assignment of the points of two patches (Sinkhorn's algorithm with a slack).

Sarlin et al., SuperGlue, CVPR 2020, section 3.2; Qin et al., CVPR 2022, section 3.3.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_ITERATIONS = 100
# Stands for infinity, with which differences would not be numbers.
_HUGE = 1e12


class OptimalTransport(nn.Module):
    """Assigns rows to columns, or to nothing.

    Attributes:
        alpha: score of an assignment to nothing.
    """

    def __init__(self) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.tensor(1.0))

    def forward(self, scores: Tensor, row_mask: Tensor, column_mask: Tensor) -> Tensor:
        """Logarithms of the assignment, (b, n + 1, m + 1); the last row and column are nothing.

        The assignment (their exponential) sums to one over each row and column that exists; to
        nothing go, at most, as many as there are.

        Args:
            scores: (b, n, m).
            row_mask: (b, n) bool, rows that exist.
            column_mask: (b, m) bool, columns that exist.
        """
        rows, columns = row_mask.sum(dim=1), column_mask.sum(dim=1)
        scale = -(rows + columns).log()[:, None]
        row_mass = _mass(row_mask, columns) + scale
        column_mass = _mass(column_mask, rows) + scale
        slack = self.alpha.expand(len(scores), 1, 1)
        scores = torch.cat((scores, slack.expand(-1, scores.shape[1], 1)), dim=2)
        scores = torch.cat((scores, slack.expand(-1, 1, scores.shape[2])), dim=1)
        existing = _with_nothing(row_mask)[:, :, None] & _with_nothing(column_mask)[:, None]
        scores = scores.masked_fill(~existing, -_HUGE)
        by_row, by_column = torch.zeros_like(row_mass), torch.zeros_like(column_mass)
        for _ in range(_ITERATIONS):
            by_row = row_mass - torch.logsumexp(scores + by_column[:, None], dim=2)
            by_column = column_mass - torch.logsumexp(scores + by_row[:, :, None], dim=1)
        return scores + by_row[:, :, None] + by_column[:, None] - scale[:, None]


def _with_nothing(mask: Tensor) -> Tensor:
    return torch.cat((mask, torch.ones_like(mask[:, :1])), dim=1)


def _mass(mask: Tensor, others: Tensor) -> Tensor:
    """Logarithm of what each has to give, (b, n + 1): one, and nothing as much as the others."""
    existing = torch.zeros(mask.shape, device=mask.device).masked_fill(~mask, -_HUGE)
    return torch.cat((existing, others.log()[:, None]), dim=1)
