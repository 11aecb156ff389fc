"""Circle loss of descriptors (Sun et al., CVPR 2020), as D3Feat and Predator learn by it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

# Distances of unit descriptors: positives are to be nearer, negatives farther apart.
_NEAR, _FAR = 0.1, 1.4


@dataclass(frozen=True, slots=True)
class Circle:
    """What is pulled together and pushed apart, how steeply.

    Attributes:
        scale: of all exponents (gamma).
        positive: points nearer than this in truth are of one place, voxels.
        safe: points farther apart than this are of different places, voxels.
    """

    scale: float
    positive: float
    safe: float


def circle_loss(described: Tensor, apart: Tensor, circle: Circle) -> Tensor:
    """The loss of source points among target points, and the other way round.

    Predator, CVPR 2021, equation 8: of each point all positives and negatives at once, each
    weighted by how far its distance is from where it should be; the weights have no gradient.
    Points without a positive or a negative are left out.

    Args:
        described: (n, m) distances of the descriptors of source and target points.
        apart: (n, m) distances in truth, voxels.
        circle: radii and scale.
    """
    positive, negative = apart < circle.positive, apart > circle.safe
    too_far = (described - _NEAR).clamp(min=0).detach()
    too_near = (_FAR - described).clamp(min=0).detach()
    pull = (circle.scale * too_far * (described - _NEAR)).masked_fill(~positive, -torch.inf)
    push = (circle.scale * too_near * (_FAR - described)).masked_fill(~negative, -torch.inf)
    sides = []
    for dimension in (0, 1):
        used = positive.any(dimension) & negative.any(dimension)
        both = pull.logsumexp(dimension)[used] + push.logsumexp(dimension)[used]
        sides.append(functional.softplus(both).sum() / (circle.scale * used.sum().clamp(min=1)))
    return torch.stack(sides).mean()
