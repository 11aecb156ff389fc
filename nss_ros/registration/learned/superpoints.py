"""Superpoints: which points belong to them, and which of two clouds correspond.

Qin et al., CVPR 2022, sections 3.1 and 3.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nss_ros.fragment import Points

#: Superpoints of two clouds that are taken to correspond.
CORRESPONDENCES = 256
#: Most points of a superpoint.
PATCH_SIZE = 64


class SuperpointMatches(NamedTuple):
    """Superpoints that correspond, the most alike first: of the target and of the source, (k,)."""

    target: Tensor
    source: Tensor


def patches(points: Points, superpoints: Points) -> Tensor:
    """The points of each superpoint, (m, PATCH_SIZE) int64; n where there is none.

    Each point belongs to the nearest superpoint, and the nearest points of a superpoint are kept.

    Args:
        points: (n, 3), metres.
        superpoints: (m, 3), metres.
    """
    distances, owners = cKDTree(superpoints).query(points)
    order = np.lexsort((distances, owners))
    sizes = np.bincount(owners, minlength=len(superpoints))
    ranks = np.arange(len(points)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    kept = ranks < PATCH_SIZE
    found = np.full((len(superpoints), PATCH_SIZE), len(points), dtype=np.int64)
    found[owners[order[kept]], ranks[kept]] = order[kept]
    return torch.from_numpy(found)


def matched_superpoints(
    target: Tensor, source: Tensor, target_mask: Tensor, source_mask: Tensor
) -> SuperpointMatches:
    """The superpoints that are most alike, compared with how alike each is to all others.

    Args:
        target: (n, c), unit features.
        source: (m, c), unit features.
        target_mask: (n,) bool, those that have points; the others correspond to none.
        source_mask: (m,) bool.
    """
    rows, columns = target_mask.nonzero()[:, 0], source_mask.nonzero()[:, 0]
    similarities = target[rows] @ source[columns].T
    scores = torch.exp(-(2 - 2 * similarities).clamp(min=0))
    scores = (scores / scores.sum(dim=1, keepdim=True)) * (scores / scores.sum(dim=0))
    best = scores.flatten().topk(min(CORRESPONDENCES, scores.numel())).indices
    return SuperpointMatches(rows[best // len(columns)], columns[best % len(columns)])
