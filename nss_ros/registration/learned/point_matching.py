"""Points that two patches have in common (Qin et al., CVPR 2022, section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor

_BEST = 3
_LEAST_CONFIDENCE = 0.05


def matched_points(assignment: Tensor, row_mask: Tensor, column_mask: Tensor) -> Tensor:
    """Which points match, (b, n, m) bool: of each the other is among the three best, surely enough.

    Args:
        assignment: (b, n, m), share of each row that is assigned to each column.
        row_mask: (b, n) bool, points that exist.
        column_mask: (b, m) bool, points that exist.
    """
    existing = row_mask[:, :, None] & column_mask[:, None]
    mutual = _among_best(assignment, 1) & _among_best(assignment, 2)
    return existing & mutual & (assignment > _LEAST_CONFIDENCE)


def _among_best(scores: Tensor, dimension: int) -> Tensor:
    best = scores.topk(_BEST, dimension).indices
    return torch.zeros_like(scores, dtype=torch.bool).scatter_(dimension, best, True)
