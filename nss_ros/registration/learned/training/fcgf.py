"""How FCGF learns: each descriptor is to be told from those of all other places.

The loss is PointInfoNCE (Xie et al., PointContrast, ECCV 2020, equation 1), which was made for this
network and learns faster than the hardest-contrastive loss of FCGF's own paper (Choy, Park, Koltun,
ICCV 2019): measured in `benchmarks/README.md`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.config import RegistrationConfig
from nss_ros.geometry import transform_points
from nss_ros.registration.learned.fcgf import one_per_voxel
from nss_ros.registration.learned.res_unet import LARGEST_STRIDE, Pyramid, ResUNet
from nss_ros.registration.learned.sparse_convolution import Voxels
from nss_ros.registration.learned.training.example import Example, correspondences

_WIDTH, _FIRST_SIZE = 32, 5
# Voxels: correspondences are at most so far apart in truth, what is nearer is no negative.
_NEAR = 1.5
_FEWEST, _MOST = 64, 2048
_TEMPERATURE = 0.05
# Voxels between the clouds of a pair, which are described at once; a multiple of all strides.
_APART = 64 * LARGEST_STRIDE


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """What the loss of a pair is calculated from.

    Attributes:
        coordinates: (n + m, 3) int64, voxels of source and target, far from each other.
        positives: (k, 2) int64, rows of points that lie on each other.
        positions: (n + m, 3) float32, true places in the target's frame, voxels.
    """

    coordinates: NDArray[np.int64]
    positives: NDArray[np.int64]
    positions: NDArray[np.float32]


class FcgfTrainee:
    """FCGF with descriptors of 32 numbers and a first kernel of five voxels."""

    learning_rate = 5e-3

    def __init__(self, config: RegistrationConfig, device: torch.device) -> None:
        self._voxel_size = config.fcgf.voxel_size
        self._device = device
        self.network = ResUNet(_WIDTH, _FIRST_SIZE).to(device)

    def prepare(self, example: Example, random: np.random.Generator) -> PreparedPair | None:
        """Voxels of a pair, with positives drawn at random."""
        size = self._voxel_size
        source, source_voxels = one_per_voxel(example.source, size)
        target, target_voxels = one_per_voxel(example.target, size)
        positives = correspondences(source, target, example.T_target_source, _NEAR * size)
        if len(positives) < _FEWEST:
            return None
        chosen = random.choice(len(positives), min(_MOST, len(positives)), replace=False)
        moved = transform_points(example.T_target_source, source)
        return PreparedPair(
            np.concatenate((source_voxels, _beyond(target_voxels, source_voxels))),
            positives[chosen] + np.array((0, len(source))),
            np.concatenate((moved, target)).astype(np.float32) / np.float32(size),
        )

    def losses(self, prepared: PreparedPair) -> Mapping[str, Tensor]:
        """Of the source's points among those of the target, and the other way round."""
        coordinates, positives, positions = (
            torch.from_numpy(each).to(self._device)
            for each in (prepared.coordinates, prepared.positives, prepared.positions)
        )
        voxels = Voxels(coordinates)
        occupied = torch.ones(len(voxels), 1, device=self._device)
        described = self.network(occupied, Pyramid.of(voxels, self.network.first_size))
        source, target = positives.unbind(dim=1)
        near = torch.cdist(positions[source], positions[target]) <= _NEAR
        similarities = described[source] @ described[target].T
        return {
            "source": confusion(similarities, near) / 2,
            "target": confusion(similarities.T, near.T) / 2,
        }


def confusion(similarities: Tensor, near: Tensor) -> Tensor:
    """How hard each positive is to tell from the others: mean cross-entropy, nats.

    Args:
        similarities: (k, k) cosines, of positives on the diagonal.
        near: (k, k) bool, of one place in truth: these are no negatives.
    """
    others = near & ~torch.eye(len(near), dtype=torch.bool, device=near.device)
    logits = (similarities / _TEMPERATURE).masked_fill(others, -torch.inf)
    return -logits.log_softmax(dim=1).diagonal().mean()


def _beyond(voxels: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.int64]:
    """Voxels shifted along x, so that no kernel reaches from them to the others."""
    gap = others[:, 0].max() - voxels[:, 0].min() + _APART
    steps = -(-gap // LARGEST_STRIDE)
    return np.add(voxels, (steps * LARGEST_STRIDE, 0, 0))
