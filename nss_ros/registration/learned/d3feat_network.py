"""The network of D3Feat (Bai et al., CVPR 2020), as the authors trained it in PyTorch on 3DMatch.

A fragment is encoded and decoded to a descriptor of every point; how well a point can be detected
is calculated from the descriptors about it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from nss_ros.registration.learned.kernel_point_network import WIDTH, KernelPointNetwork, Recipe
from nss_ros.registration.learned.kernel_points import with_shadow
from nss_ros.registration.learned.pyramid import Level

DEPTH = 5
DESCRIPTORS = 32

_CHUNK = 8192


class D3FeatNetwork(KernelPointNetwork):
    """Descriptors and detection scores of a fragment."""

    def __init__(self, voxel_size: float) -> None:
        """For clouds of `voxel_size` metres."""
        recipe = Recipe(Bias, True, voxel_size, DEPTH)
        super().__init__(recipe, 2 ** (DEPTH - 1) * WIDTH, DESCRIPTORS)

    def forward(self, levels: Sequence[Level]) -> tuple[Tensor, Tensor]:
        """Of the pyramid of one fragment: a row for each point of the finest level.

        Returns:
            Unit descriptors (n, 32) and detection scores (n,), zero where nothing is detected
            but in training, which needs a gradient everywhere (section 3.3 of the paper).
        """
        ones = torch.ones_like(levels[0].points[:, :1])
        features = self.decoded(*self.encoded(ones, levels), levels)
        scores = detection_scores(features, levels[0].neighbours, everywhere=self.training)
        return functional.normalize(features), scores


class Bias(nn.Module):
    """What the network has in place of normalisation."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, features: Tensor) -> Tensor:
        """(n, c) to (n, c)."""
        return features + self.bias


def detection_scores(features: Tensor, neighbours: Tensor, everywhere: bool = False) -> Tensor:
    """How distinctive each point is, (n,) (section 3.2 of the paper).

    A score is the largest, over the channels, of how much a feature exceeds its neighbourhood
    and of how it compares to the point's largest feature. Points that exceed their neighbours in
    no channel score zero, as in the authors' tests.

    Args:
        features: (n, c), not normalised.
        neighbours: (n, h) int64, indices, the point itself among them; n where there is none.
        everywhere: no point scores zero for not exceeding its neighbours, as in training.
    """
    features = features / (features.max() + 1e-6)
    shadowed = with_shadow(features)
    chunks = zip(torch.split(features, _CHUNK), torch.split(neighbours, _CHUNK), strict=True)
    return torch.cat([_scores(each, shadowed[near], everywhere) for each, near in chunks])


def _scores(features: Tensor, about: Tensor, everywhere: bool) -> Tensor:
    """(n,) of features (n, c) and those of the neighbours (n, h, c)."""
    count = (about.sum(dim=2) != 0).sum(dim=1, keepdim=True).clamp(min=1)
    salient = functional.softplus(features - about.sum(dim=1) / count)
    dominant = features / (features.amax(dim=1, keepdim=True) + 1e-6)
    scores = (salient * dominant).amax(dim=1)
    if everywhere:
        return scores
    return scores * (features == about.amax(dim=1)).any(dim=1)
