"""Registration by GeoTransformer: matches of a network, local-to-global registration, ICP."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, Points, clean_points
from nss_ros.geometry import Transform
from nss_ros.registration.features import FragmentSurface, surface_of
from nss_ros.registration.learned.checkpoint import chosen_device, load_weights
from nss_ros.registration.learned.geometric_embedding import NEIGHBOURS
from nss_ros.registration.learned.geotransformer_backbone import RADIUS
from nss_ros.registration.learned.geotransformer_network import GeoTransformerNetwork
from nss_ros.registration.learned.local_to_global import PatchMatches, local_to_global
from nss_ros.registration.learned.method import LearnedMethod, normals_at
from nss_ros.registration.learned.pyramid import grid_subsampled, pyramid
from nss_ros.registration.ransac import Matches

_PUBLISHED = "https://github.com/qinzheng93/GeoTransformer/releases"
#: Most neighbours on each level, as the authors counted them on 3DMatch.
LIMITS = (38, 36, 36, 38)
# A match agrees when it ends closer than this, in voxels: 0.1 m.
_ACCEPTANCE = 4


@dataclass(frozen=True, slots=True)
class GeoTransformerFeatures(FragmentSurface):
    """What the method keeps of a fragment; the network sees pairs.

    Attributes:
        cloud: (k, 3) float32, voxelised for the network, metres, sensor frame.
    """

    cloud: Points


class GeoTransformer(LearnedMethod[GeoTransformerFeatures]):
    """Geometric transformer, local-to-global registration, point-to-plane ICP."""

    name = "geotransformer"

    def __init__(self, config: RegistrationConfig) -> None:
        settings = config.geotransformer
        super().__init__(config, settings)
        self._voxel_size = settings.voxel_size
        self._device = chosen_device(settings.device)
        network = GeoTransformerNetwork(settings.voxel_size)
        load_weights(network, settings.weights, self.name, _PUBLISHED)
        self._network = network.to(self._device)

    def prepare(self, fragment: Fragment) -> GeoTransformerFeatures:
        """Voxelised points with normals, and the points that the network will see."""
        surface = surface_of(fragment, self.config)
        return GeoTransformerFeatures(
            surface.id,
            surface.gravity_aligned,
            surface.points,
            surface.normals,
            grid_subsampled(clean_points(fragment.points), self._voxel_size),
        )

    def _matches(
        self, source: GeoTransformerFeatures, target: GeoTransformerFeatures
    ) -> PatchMatches:
        """The matches of the network; none where a fragment has too few superpoints."""
        levels = pyramid(
            (target.cloud, source.cloud),
            self._voxel_size,
            RADIUS * self._voxel_size,
            LIMITS,
            self._device,
        )
        if min(levels[-1].lengths) <= NEIGHBOURS:
            return PatchMatches(*(np.zeros((0, 3)),) * 4, np.zeros(0), np.zeros(0, dtype=np.int64))
        with torch.inference_mode():
            found = self._network(levels)
        from_target, from_source = (each.cpu().numpy() for each in (found.target, found.source))
        return PatchMatches(
            from_source.astype(np.float64),
            from_target.astype(np.float64),
            normals_at(from_source, source).astype(np.float64),
            normals_at(from_target, target).astype(np.float64),
            found.scores.cpu().numpy().astype(np.float64),
            found.patches.cpu().numpy(),
        )

    def _candidates(self, matches: Matches, level: bool, seed: int) -> list[Transform]:  # noqa: ARG002
        """The transform of local-to-global registration, which draws nothing at random."""
        assert isinstance(matches, PatchMatches)
        found = local_to_global(matches, _ACCEPTANCE * self._voxel_size)
        return [] if found is None else [found]
