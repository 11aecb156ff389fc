"""FCGF: a sparse convolutional network describes voxels (Choy, Park, Koltun, ICCV 2019).

Descriptors are compared by direction: those of checkpoints trained without normalisation (two of
the authors' for KITTI) are made unit too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, Points, clean_points, occupied_voxels
from nss_ros.registration.features import FragmentSurface, surface_of
from nss_ros.registration.learned.checkpoint import (
    chosen_device,
    fill,
    read_weights,
    weights_setting,
)
from nss_ros.registration.learned.method import (
    Described,
    LearnedMethod,
    matched,
    normals_at,
    quantised,
)
from nss_ros.registration.learned.res_unet import Pyramid, ResUNet, sizes
from nss_ros.registration.learned.sparse_convolution import LIMIT, Voxels
from nss_ros.registration.ransac import Matches

_PUBLISHED = "https://github.com/chrischoy/FCGF#model-zoo"
# Points that are farther off than voxels can be are left out; this leaves room for kernels.
_FARTHEST = LIMIT - 1024


@dataclass(frozen=True, slots=True)
class FcgfFeatures(FragmentSurface):
    """What the method keeps of a fragment.

    Attributes:
        described: keypoints.
    """

    described: Described


class Fcgf(LearnedMethod[FcgfFeatures]):
    """FCGF, mutual matches, RANSAC, point-to-plane ICP.

    Raises:
        MethodError: the weights are not given, cannot be read or are of another network, or the
            device is missing.
    """

    name = "fcgf"

    def __init__(self, config: RegistrationConfig) -> None:
        super().__init__(config, config.fcgf)
        self._device = chosen_device(config.fcgf.device)
        self._network = _loaded(config.fcgf.weights, self._device)

    def prepare(self, fragment: Fragment) -> FcgfFeatures:
        """Voxelised points, normals and described keypoints of a fragment."""
        surface = surface_of(fragment, self.config)
        points, voxels = one_per_voxel(clean_points(fragment.points), self.config.fcgf.voxel_size)
        descriptors = describe(self._network, voxels, self._device)
        chosen = self._chosen(len(points))
        return FcgfFeatures(
            surface.id,
            surface.gravity_aligned,
            surface.points,
            surface.normals,
            Described(
                points[chosen],
                normals_at(points[chosen], surface),
                quantised(descriptors[chosen]),
            ),
        )

    def _chosen(self, count: int) -> NDArray[np.int64]:
        """A sample of points in ascending order; the authors match a random one."""
        most = self.config.fcgf.max_keypoints
        if count <= most:
            return np.arange(count)
        random = np.random.default_rng(self.config.seed)
        return np.sort(random.choice(count, most, replace=False))

    def _matches(self, source: FcgfFeatures, target: FcgfFeatures) -> Matches:
        return matched(source.described, target.described)


def one_per_voxel(points: Points, voxel_size: float) -> tuple[Points, NDArray[np.int64]]:
    """The first point in every occupied voxel, as the authors have it, and the voxels.

    Args:
        points: (n, 3) finite, metres.
        voxel_size: metres.

    Returns:
        Points (m, 3) and coordinates of their voxels (m, 3), ordered by the latter. Points of
        which a network could not number the voxels, thousands of metres off, are left out.
    """
    floors = np.floor(points.astype(np.float64) / voxel_size)
    near = (np.abs(floors) < _FARTHEST).all(axis=1)
    points, coordinates = points[near], floors[near].astype(np.int64)
    _, first = np.unique(occupied_voxels(coordinates, 1.0)[0], return_index=True)
    return points[first], coordinates[first]


def describe(
    network: ResUNet, coordinates: NDArray[np.int64], device: torch.device
) -> NDArray[np.float32]:
    """Unit descriptors (n, width) float32 of voxels (n, 3)."""
    voxels = Voxels(torch.from_numpy(coordinates).to(device))
    occupied = torch.ones(len(voxels), 1, device=device)
    with torch.inference_mode():
        descriptors = network(occupied, Pyramid.of(voxels, network.first_size))
    return np.asarray(descriptors.cpu().numpy())


@cache
def _loaded(path: str, device: torch.device) -> ResUNet:
    """The network of a checkpoint; its sizes are read off its tensors."""
    tensors = read_weights(path, Fcgf.name, _PUBLISHED)
    network = ResUNet(*sizes(tensors))
    fill(network, tensors, path, weights_setting(Fcgf.name))
    return network.to(device)
