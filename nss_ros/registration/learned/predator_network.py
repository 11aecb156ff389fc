"""The network of Predator (Huang et al., CVPR 2021), as trained on 3DMatch.

Two fragments are encoded at once, exchange on the coarsest level what they have seen, and are
decoded to descriptors and to two scores of every point: that it lies in the overlap, and that its
descriptor will be matched.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from nss_ros.registration.learned.graph_attention import GraphNetwork
from nss_ros.registration.learned.kernel_point_network import KernelPointNetwork, Recipe
from nss_ros.registration.learned.pyramid import Level

DEPTH = 4
DESCRIPTORS = 32

_CHANNELS = 256
_COARSEST = 1024
_TEMPERATURE = 0.03


class PredatorNetwork(KernelPointNetwork):
    """Descriptors, overlap and saliency of two fragments (section 3 of the paper).

    Attributes:
        epsilon: logarithm of what is added to the temperature of cross-saliency.
    """

    def __init__(self, voxel_size: float) -> None:
        """For clouds of `voxel_size` metres."""
        recipe = Recipe(InstanceNormalisation, False, voxel_size, DEPTH)
        super().__init__(recipe, _CHANNELS + 2, DESCRIPTORS + 2)
        self.epsilon = nn.Parameter(torch.tensor(-5.0))
        self.bottle = nn.Conv1d(_COARSEST, _CHANNELS, 1)
        self.gnn = GraphNetwork(_CHANNELS)
        self.proj_gnn = nn.Conv1d(_CHANNELS, _CHANNELS, 1)
        self.proj_score = nn.Conv1d(_CHANNELS, 1, 1)

    def forward(self, levels: Sequence[Level]) -> tuple[Tensor, Tensor, Tensor]:
        """Of the pyramid of a source and a target: one row for each point of the finest level.

        Returns:
            Unit descriptors (n, 32), overlap (n,) and saliency (n,) in 0..1.
        """
        ones = torch.ones_like(levels[0].points[:, :1])
        coarse, kept = self.encoded(ones, levels)
        fine = self.decoded(self._exchanged(coarse, levels[-1]), kept, levels)
        scores = torch.sigmoid(fine[:, DESCRIPTORS:]).nan_to_num(0.0)
        return functional.normalize(fine[:, :DESCRIPTORS]), scores[:, 0], scores[:, 1]

    def _exchanged(self, features: Tensor, level: Level) -> Tensor:
        """Overlap, cross-saliency and conditioned features of the coarsest level, (n, 258)."""
        split = list(level.lengths)
        points = level.points.split_with_sizes(split)
        channels = self.bottle(features.T[None]).split_with_sizes(split, dim=2)
        conditioned = self.proj_gnn(torch.cat(self.gnn(points, channels), dim=2))
        scores = self.proj_score(conditioned)[0].T
        conditioned = conditioned[0].T
        saliency = self._cross_saliency(
            functional.normalize(conditioned).split_with_sizes(split),
            scores.split_with_sizes(split),
        )
        return torch.cat((scores, saliency, conditioned), dim=1)

    def _cross_saliency(self, features: Sequence[Tensor], scores: Sequence[Tensor]) -> Tensor:
        """The overlap scores of the other fragment's similar points (equation 4), (n, 1)."""
        source, target = features
        similar = source @ target.T / (self.epsilon.exp() + _TEMPERATURE)
        forward = similar.softmax(dim=1) @ scores[1]
        backward = similar.T.softmax(dim=1) @ scores[0]
        return torch.cat((forward, backward))


class InstanceNormalisation(nn.Module):
    """Each channel shifted and scaled to mean 0 and variance 1 over all points of a pair."""

    def __init__(self, _: int) -> None:
        super().__init__()

    def forward(self, features: Tensor) -> Tensor:
        """(n, c) to (n, c)."""
        variance, mean = torch.var_mean(features, dim=0, correction=0)
        return (features - mean) * torch.rsqrt(variance + 1e-5)
