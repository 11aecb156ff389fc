"""Registration by Predator (Huang et al., CVPR 2021): a network that looks at both fragments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentPair, Points, clean_points, voxelize
from nss_ros.registration.features import FragmentSurface, surface_of
from nss_ros.registration.learned.checkpoint import chosen_device, load_weights
from nss_ros.registration.learned.kernel_point_network import LIMITS, RADIUS
from nss_ros.registration.learned.method import (
    Described,
    LearnedMethod,
    matched,
    normals_at,
    quantised,
)
from nss_ros.registration.learned.predator_network import DEPTH, PredatorNetwork
from nss_ros.registration.learned.pyramid import pyramid
from nss_ros.registration.ransac import Matches
from nss_ros.registration.seed import pair_seed

_PUBLISHED = "indoor.pth of github.com/prs-eth/OverlapPredator"


@dataclass(frozen=True, slots=True)
class PredatorFeatures(FragmentSurface):
    """What the method keeps of a fragment.

    Attributes:
        dense: (n, 3) float32, voxelised for the network, metres, sensor frame.
    """

    dense: Points


class Predator(LearnedMethod[PredatorFeatures]):
    """Predator's keypoints and descriptors, mutual matches, RANSAC, point-to-plane ICP."""

    name = "predator"

    def __init__(self, config: RegistrationConfig) -> None:
        super().__init__(config, config.predator)
        self._voxel_size = config.predator.voxel_size
        self._device = chosen_device(config.predator.device)
        self._network = PredatorNetwork(self._voxel_size)
        load_weights(self._network, config.predator.weights, self.name, _PUBLISHED)
        self._network.to(self._device)

    def prepare(self, fragment: Fragment) -> PredatorFeatures:
        """Points voxelised for refinement, with normals, and for the network."""
        surface = surface_of(fragment, self.config)
        return PredatorFeatures(
            surface.id,
            surface.gravity_aligned,
            surface.points,
            surface.normals,
            voxelize(clean_points(fragment.points), self._voxel_size),
        )

    def _matches(self, source: PredatorFeatures, target: PredatorFeatures) -> Matches:
        clouds, voxel_size = [source.dense, target.dense], self._voxel_size
        levels = pyramid(clouds, voxel_size, RADIUS * voxel_size, LIMITS[:DEPTH], self._device)
        with torch.inference_mode():
            descriptors, overlap, saliency = self._network(levels)
        scores, lengths = overlap * saliency, list(levels[0].lengths)
        random = np.random.default_rng(pair_seed(FragmentPair(source.id, target.id)))
        described = [
            self._described(*each, random)
            for each in zip(
                (source, target), descriptors.split(lengths), scores.split(lengths), strict=True
            )
        ]
        return matched(*described)

    def _described(
        self,
        features: PredatorFeatures,
        descriptors: Tensor,
        scores: Tensor,
        random: np.random.Generator,
    ) -> Described:
        chosen = drawn(scores.cpu().numpy(), self.config.predator.max_keypoints, random)
        keypoints = features.dense[chosen]
        return Described(
            keypoints,
            normals_at(keypoints, features),
            quantised(descriptors.cpu().numpy()[chosen]),
        )


def drawn(
    scores: NDArray[np.float32], count: int, random: np.random.Generator
) -> NDArray[np.int64]:
    """Indices of up to `count` points, drawn one by one in proportion to scores (n,), in order.

    The authors draw keypoints so; those with the highest scores alone would lie in few places.
    Points of score zero come last. Each point gets a time to wait, exponential with its score as
    rate, and the first to come are drawn, which is the same (Efraimidis and Spirakis 2006).
    """
    waits = random.exponential(size=len(scores))
    with np.errstate(divide="ignore"):
        times = waits / scores
    return np.sort(np.argsort(times, kind="stable")[:count])
