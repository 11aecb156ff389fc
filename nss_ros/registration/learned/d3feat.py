"""Registration by D3Feat (Bai et al., CVPR 2020): one network detects and describes keypoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, Points, clean_points, voxelize
from nss_ros.registration.features import FragmentSurface, surface_of
from nss_ros.registration.learned.checkpoint import chosen_device, load_weights
from nss_ros.registration.learned.d3feat_network import DEPTH, DESCRIPTORS, D3FeatNetwork
from nss_ros.registration.learned.kernel_point_network import LIMITS, RADIUS
from nss_ros.registration.learned.method import (
    Described,
    LearnedMethod,
    matched,
    normals_at,
    quantised,
)
from nss_ros.registration.learned.pyramid import pyramid
from nss_ros.registration.ransac import Matches

_PUBLISHED = "the 'Pretrained weights' of github.com/XuyangBai/D3Feat.pytorch"
# The published weights are older than these biases, which the authors' code has had since
# November 2020: https://github.com/XuyangBai/D3Feat.pytorch/issues/8.
_OPTIONAL = ".mlp.bias"


@dataclass(frozen=True, slots=True)
class D3FeatFeatures(FragmentSurface):
    """What the method keeps of a fragment.

    Attributes:
        described: the keypoints.
    """

    described: Described


class D3Feat(LearnedMethod[D3FeatFeatures]):
    """D3Feat keypoints and descriptors, mutual matches, RANSAC, point-to-plane ICP."""

    name = "d3feat"

    def __init__(self, config: RegistrationConfig) -> None:
        super().__init__(config, config.d3feat)
        self._voxel_size = config.d3feat.voxel_size
        self._device = chosen_device(config.d3feat.device)
        self._network = D3FeatNetwork(self._voxel_size)
        load_weights(self._network, config.d3feat.weights, self.name, _PUBLISHED, _OPTIONAL)
        self._network.to(self._device)

    def prepare(self, fragment: Fragment) -> D3FeatFeatures:
        """Voxelised points and normals, and the keypoints with the highest detection scores."""
        surface = surface_of(fragment, self.config)
        points = voxelize(clean_points(fragment.points), self._voxel_size)
        return D3FeatFeatures(
            surface.id,
            surface.gravity_aligned,
            surface.points,
            surface.normals,
            self._described(points, surface),
        )

    def _described(self, points: Points, surface: FragmentSurface) -> Described:
        if len(points) == 0:
            return Described(points, points, np.zeros((0, DESCRIPTORS), dtype=np.float32))
        voxel_size = self._voxel_size
        levels = pyramid([points], voxel_size, RADIUS * voxel_size, LIMITS[:DEPTH], self._device)
        with torch.inference_mode():
            descriptors, scores = self._network(levels)
        order = np.argsort(-scores.cpu().numpy(), kind="stable")[: self.config.d3feat.max_keypoints]
        keypoints = points[order]
        return Described(
            keypoints,
            normals_at(keypoints, surface),
            quantised(descriptors.cpu().numpy()[order]),
        )

    def _matches(self, source: D3FeatFeatures, target: D3FeatFeatures) -> Matches:
        return matched(source.described, target.described)
