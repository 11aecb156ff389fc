"""How D3Feat learns: descriptors that tell places apart, and where they do so best.

Bai et al., CVPR 2020, section 4; the descriptor loss is the circle loss, as in the authors' PyTorch
version, whose checkpoint is the one that they publish for 3DMatch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import voxelize
from nss_ros.registration.learned.d3feat_network import DEPTH, D3FeatNetwork
from nss_ros.registration.learned.kernel_point_network import LIMITS, RADIUS
from nss_ros.registration.learned.pyramid import Level, pyramid
from nss_ros.registration.learned.training.circle_loss import circle_loss
from nss_ros.registration.learned.training.example import Example
from nss_ros.registration.learned.training.matched_sample import MatchedSample, matched_sample

# Voxels: points nearer than this are of one place, farther apart than that of different ones.
_POSITIVE, _SAFE = 1.5, 3.5
_SCALE = 10
_DRAWN = 256


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """What the losses of a pair are calculated from.

    Attributes:
        source: pyramid of the source.
        target: pyramid of the target.
        sample: correspondences.
    """

    source: list[Level]
    target: list[Level]
    sample: MatchedSample


class D3FeatTrainee:
    """D3Feat, from untrained weights."""

    learning_rate = 1e-3

    def __init__(self, config: RegistrationConfig, device: torch.device) -> None:
        self._voxel_size = config.d3feat.voxel_size
        self._device = device
        self.network = D3FeatNetwork(self._voxel_size).to(device)

    def prepare(self, example: Example, random: np.random.Generator) -> PreparedPair | None:
        """Pyramids and correspondences."""
        size = self._voxel_size
        source, target = voxelize(example.source, size), voxelize(example.target, size)
        sample = matched_sample(
            source, target, example.T_target_source, size, _POSITIVE, _DRAWN, random
        )
        if sample is None:
            return None
        first, second = (
            pyramid([cloud], size, RADIUS * size, LIMITS[:DEPTH], self._device)
            for cloud in (source, target)
        )
        return PreparedPair(first, second, sample)

    def losses(self, prepared: PreparedPair) -> Mapping[str, Tensor]:
        """Of descriptors and of detection (equation 10)."""
        sample = prepared.sample
        first = len(sample.positions) - len(prepared.target[0].points)
        source_rows, target_rows = (
            torch.from_numpy(each).to(self._device) for each in (sample.source, sample.target)
        )
        positions = torch.from_numpy(sample.positions).to(self._device)
        source, source_scores = self.network(prepared.source)
        target, target_scores = self.network(prepared.target)
        described = torch.cdist(source[source_rows], target[target_rows])
        apart = torch.cdist(positions[source_rows], positions[first + target_rows])
        scores = source_scores[source_rows] + target_scores[target_rows]
        return {
            "descriptor": circle_loss(described, apart < _POSITIVE, apart > _SAFE, _SCALE),
            "detector": detector_loss(described, apart, scores),
        }


def detector_loss(described: Tensor, apart: Tensor, scores: Tensor) -> Tensor:
    """High scores are to be where a descriptor is nearer to its own than to any other.

    Args:
        described: (k, k) distances of descriptors, of correspondences on the diagonal.
        apart: (k, k) distances in truth, voxels.
        scores: (k,) of both points of each correspondence.
    """
    hardest = described.masked_fill(apart <= _SAFE, torch.inf).amin(dim=1)
    used = hardest.isfinite()
    gain = (described.diagonal() - hardest)[used]
    return (gain * scores[used]).sum() / used.sum().clamp(min=1)
