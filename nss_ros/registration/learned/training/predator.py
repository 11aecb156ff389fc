"""How Predator learns: descriptors, what overlaps, and what will be matched.

Huang et al., CVPR 2021, section 3.3; radii are those of its authors on 3DMatch, in voxels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import voxelize
from nss_ros.registration.learned.kernel_point_network import LIMITS, RADIUS
from nss_ros.registration.learned.predator_network import DEPTH, PredatorNetwork
from nss_ros.registration.learned.pyramid import Level, pyramid
from nss_ros.registration.learned.training.circle_loss import circle_loss
from nss_ros.registration.learned.training.example import Example
from nss_ros.registration.learned.training.matched_sample import MatchedSample, matched_sample

# Voxels: points nearer than this are of one place, farther apart than that of different ones.
_POSITIVE, _SAFE = 1.5, 4.0
_SCALE = 24
_MATCHED = 2.0
_DRAWN = 256
# Points whose match is looked for, among all that overlap.
_LOOKED_FOR = 1024


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """What the losses of a pair are calculated from.

    Attributes:
        levels: pyramid of source and target.
        sample: correspondences.
        looked_for: rows of overlapping points, of the source and of the target, each (k,) int64.
    """

    levels: list[Level]
    sample: MatchedSample
    looked_for: tuple[Tensor, Tensor]


class PredatorTrainee:
    """Predator, from untrained weights."""

    learning_rate = 1e-3

    def __init__(self, config: RegistrationConfig, device: torch.device) -> None:
        self._voxel_size = config.predator.voxel_size
        self._device = device
        self.network = PredatorNetwork(self._voxel_size).to(device)

    def prepare(self, example: Example, random: np.random.Generator) -> PreparedPair | None:
        """The pyramid of both clouds, and correspondences."""
        size = self._voxel_size
        source, target = voxelize(example.source, size), voxelize(example.target, size)
        sample = matched_sample(
            source, target, example.T_target_source, size, _POSITIVE, _DRAWN, random
        )
        if sample is None:
            return None
        rows = np.flatnonzero(sample.overlap)
        sides = rows[rows < len(source)], rows[rows >= len(source)]
        looked_for = tuple(
            torch.from_numpy(random.permutation(side)[:_LOOKED_FOR]).to(self._device)
            for side in sides
        )
        levels = pyramid([source, target], size, RADIUS * size, LIMITS[:DEPTH], self._device)
        return PreparedPair(levels, sample, (looked_for[0], looked_for[1]))

    def losses(self, prepared: PreparedPair) -> Mapping[str, Tensor]:
        """Of descriptors, of overlap and of saliency, of equal weight."""
        sample, first = prepared.sample, prepared.levels[0].lengths[0]
        source, target, positions, overlaps = (
            torch.from_numpy(each).to(self._device)
            for each in (sample.source, sample.target, sample.positions, sample.overlap)
        )
        descriptors, overlap, saliency = self.network(prepared.levels)
        target = first + target
        described = torch.cdist(descriptors[source], descriptors[target])
        apart = torch.cdist(positions[source], positions[target])
        rows = torch.cat(prepared.looked_for)
        found = self._found(descriptors.detach(), positions, overlaps, first, prepared.looked_for)
        return {
            "descriptor": circle_loss(described, apart < _POSITIVE, apart > _SAFE, _SCALE),
            "overlap": balanced_cross_entropy(overlap, overlaps),
            "saliency": balanced_cross_entropy(saliency[rows], found),
        }

    @staticmethod
    def _found(
        descriptors: Tensor,
        positions: Tensor,
        overlaps: Tensor,
        first: int,
        looked_for: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Whether the most similar point of the other cloud's overlap is the right one, bool."""
        rows = overlaps.nonzero()[:, 0]
        others = rows[rows >= first], rows[rows < first]
        found = []
        for anchors, candidates in zip(looked_for, others, strict=True):
            similar = descriptors[anchors] @ descriptors[candidates].T
            best = candidates[similar.argmax(dim=1)]
            found.append((positions[anchors] - positions[best]).norm(dim=1) < _MATCHED)
        return torch.cat(found)


def balanced_cross_entropy(probabilities: Tensor, labels: Tensor) -> Tensor:
    """Mean binary cross-entropy in which both classes weigh the same (equations 9 and 11).

    Args:
        probabilities: (n,) in 0..1.
        labels: (n,) bool.
    """
    share = labels.float().mean()
    weights = torch.where(labels, 1 - share, share)
    return functional.binary_cross_entropy(probabilities, labels.float(), weights)
