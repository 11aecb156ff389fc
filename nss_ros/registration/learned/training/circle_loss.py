"""Circle loss of descriptors (Sun et al., CVPR 2020), as the kernel point networks learn by it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

# Distances of unit descriptors: positives are to be nearer, negatives farther apart.
_NEAR, _FAR = 0.1, 1.4


def circle_loss(
    described: Tensor,
    positive: Tensor,
    negative: Tensor,
    scale: float,
    weights: Tensor | None = None,
) -> Tensor:
    """The loss of source points among target points, and the other way round.

    Predator, CVPR 2021, equation 8: of each point all positives and negatives at once, each
    weighted by how far its distance is from where it should be; these weights have no gradient.
    Points without a positive or a negative are left out.

    Args:
        described: (n, m) distances of the unit descriptors of source and target points.
        positive: (n, m) bool, which are of one place.
        negative: (n, m) bool, which are of different places.
        scale: of all exponents (gamma).
        weights: (n, m) of the positives; None: all the same.
    """
    too_far = (described - _NEAR).clamp(min=0).detach()
    too_near = (_FAR - described).clamp(min=0).detach()
    if weights is not None:
        too_far = too_far * weights
    pull = (scale * too_far * (described - _NEAR)).masked_fill(~positive, -torch.inf)
    push = (scale * too_near * (_FAR - described)).masked_fill(~negative, -torch.inf)
    sides = []
    for dimension in (0, 1):
        used = positive.any(dimension) & negative.any(dimension)
        both = pull.logsumexp(dimension)[used] + push.logsumexp(dimension)[used]
        sides.append(functional.softplus(both).sum() / (scale * used.sum().clamp(min=1)))
    return torch.stack(sides).mean()
