"""How FCGF learns: hardest-contrastive loss (Choy, Park, Koltun, ICCV 2019, section 4)."""

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
_FEWEST, _MOST_POSITIVES, _CANDIDATES = 64, 2048, 1024
_POSITIVE_MARGIN, _NEGATIVE_MARGIN = 0.1, 1.4
_NEGATIVE_WEIGHT = 0.5
# Voxels between the clouds of a pair, which are described at once; a multiple of all strides.
_APART = 64 * LARGEST_STRIDE


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """What the loss of a pair is calculated from.

    Attributes:
        coordinates: (n + m, 3) int64, voxels of source and target, far from each other.
        positives: (k, 2) int64, rows of points that lie on each other.
        candidates: two times (c,) int64, rows of the source and of the target among which the
            hardest negative is looked for.
        positions: (n + m, 3) float32, true places in the target's frame, voxels.
    """

    coordinates: NDArray[np.int64]
    positives: NDArray[np.int64]
    candidates: tuple[NDArray[np.int64], NDArray[np.int64]]
    positions: NDArray[np.float32]


class FcgfTrainee:
    """FCGF with descriptors of 32 numbers and a first kernel of five voxels."""

    learning_rate = 2e-3

    def __init__(self, config: RegistrationConfig, device: torch.device) -> None:
        self._voxel_size = config.fcgf.voxel_size
        self._device = device
        self.network = ResUNet(_WIDTH, _FIRST_SIZE).to(device)

    def prepare(self, example: Example, random: np.random.Generator) -> PreparedPair | None:
        """Voxels of a pair, with positives and candidates drawn at random."""
        size = self._voxel_size
        source, source_voxels = one_per_voxel(example.source, size)
        target, target_voxels = one_per_voxel(example.target, size)
        positives = correspondences(source, target, example.T_target_source, _NEAR * size)
        if len(positives) < _FEWEST:
            return None
        count, first = min(_MOST_POSITIVES, len(positives)), len(source)
        positives = positives[random.choice(len(positives), count, replace=False)]
        moved = transform_points(example.T_target_source, source)
        return PreparedPair(
            np.concatenate((source_voxels, _beyond(target_voxels, source_voxels))),
            positives + np.array((0, first)),
            (
                random.integers(0, first, _CANDIDATES),
                random.integers(first, first + len(target), _CANDIDATES),
            ),
            np.concatenate((moved, target)).astype(np.float32) / np.float32(size),
        )

    def losses(self, prepared: PreparedPair) -> Mapping[str, Tensor]:
        """Positive and negative part of the loss."""
        coordinates, positives, positions = (
            torch.from_numpy(each).to(self._device)
            for each in (prepared.coordinates, prepared.positives, prepared.positions)
        )
        voxels = Voxels(coordinates)
        occupied = torch.ones(len(voxels), 1, device=self._device)
        described = self.network(occupied, Pyramid.of(voxels, self.network.first_size))
        of_source, of_target = (
            torch.from_numpy(each).to(self._device) for each in prepared.candidates
        )
        source, target = positives.unbind(dim=1)
        negative = hardest_negative(described, positions, source, of_target)
        negative = negative + hardest_negative(described, positions, target, of_source)
        return {
            "positive": positive_loss(described[source], described[target]),
            "negative": _NEGATIVE_WEIGHT * negative,
        }


def positive_loss(one: Tensor, other: Tensor) -> Tensor:
    """How far the descriptors (k, c) of corresponding points are apart, beyond a margin."""
    distances: Tensor = (one - other).norm(dim=1)
    return (distances - _POSITIVE_MARGIN).clamp(min=0).square().mean()


def hardest_negative(
    described: Tensor, positions: Tensor, anchors: Tensor, candidates: Tensor
) -> Tensor:
    """How near, within a margin, the nearest descriptor is that belongs to another place.

    Args:
        described: (n, c) unit descriptors.
        positions: (n, 3) true places, voxels.
        anchors: (k,) rows.
        candidates: (m,) rows of the other cloud.
    """
    same_place = torch.cdist(positions[anchors], positions[candidates]) <= _NEAR
    distances = torch.cdist(described[anchors], described[candidates])
    hardest = distances.masked_fill(same_place, torch.inf).amin(dim=1)
    return (_NEGATIVE_MARGIN - hardest).clamp(min=0).square().mean()


def _beyond(voxels: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.int64]:
    """Voxels shifted along x, so that no kernel reaches from them to the others."""
    gap = others[:, 0].max() - voxels[:, 0].min() + _APART
    steps = -(-gap // LARGEST_STRIDE)
    return np.add(voxels, (steps * LARGEST_STRIDE, 0, 0))
