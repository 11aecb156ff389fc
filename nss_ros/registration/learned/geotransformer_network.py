"""GeoTransformer (Qin et al.: Geometric Transformer, CVPR 2022), as trained on 3DMatch.

Parameters are named as in the checkpoints of the authors. All lengths are those of their 3DMatch
experiment, in voxels of the finest level.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nss_ros.registration.learned.geometric_transformer import GeometricTransformer
from nss_ros.registration.learned.geotransformer_backbone import Backbone
from nss_ros.registration.learned.kernel_points import with_shadow
from nss_ros.registration.learned.optimal_transport import OptimalTransport
from nss_ros.registration.learned.point_matching import matched_points
from nss_ros.registration.learned.pyramid import Level
from nss_ros.registration.learned.superpoints import matched_superpoints, patches

_SUPERPOINT_CHANNELS, _CHANNELS = 1024, 256
#: Distance of superpoints that counts as one: 0.2 m.
_SIGMA = 8


class PointMatches(NamedTuple):
    """Points that match, by pairs of patches.

    Attributes:
        target: (m, 3), metres.
        source: (m, 3), metres.
        scores: (m,) share of a point that is assigned to the other.
        patches: (m,) number of the pair of patches, ascending.
    """

    target: Tensor
    source: Tensor
    scores: Tensor
    patches: Tensor


class Cloud(NamedTuple):
    """What is matched of one of the clouds.

    Attributes:
        points: (n, 3), of the second level, metres.
        features: (n, c) of the points.
        superpoints: (m, 3), metres.
        descriptors: (m, d) of the superpoints.
        patches: (m, k) points of the superpoints; n where there is none.
    """

    points: Tensor
    features: Tensor
    superpoints: Tensor
    descriptors: Tensor
    patches: Tensor

    @property
    def mask(self) -> Tensor:
        """Which points of the superpoints exist, (m, k) bool."""
        return self.patches < len(self.points)


class GeoTransformerNetwork(nn.Module):
    """Matches the points of two clouds.

    Args:
        voxel_size: of the finest level, metres.
    """

    def __init__(self, voxel_size: float) -> None:
        super().__init__()
        self.backbone = Backbone(voxel_size)
        self.transformer = GeometricTransformer(
            _SUPERPOINT_CHANNELS, _CHANNELS, _SIGMA * voxel_size
        )
        self.optimal_transport = OptimalTransport()

    def forward(self, levels: list[Level]) -> PointMatches:
        """The matches of a pair.

        Args:
            levels: four, of the target and the source, with more than three superpoints each.
        """
        return self.matches(*self.describe(levels))

    def describe(self, levels: list[Level]) -> tuple[Cloud, Cloud]:
        """Target and source with their features."""
        fine, coarse = levels[1], levels[3]
        fine_features, coarse_features = self.backbone(levels)
        target_points, source_points = torch.split(coarse.points, list(coarse.lengths))
        target, source = self.transformer(
            target_points, source_points, *torch.split(coarse_features, list(coarse.lengths))
        )
        points = torch.split(fine.points, list(fine.lengths))
        features = torch.split(fine_features, list(fine.lengths))
        return (
            _cloud(points[0], features[0], target_points, target),
            _cloud(points[1], features[1], source_points, source),
        )

    def matches(self, target: Cloud, source: Cloud) -> PointMatches:
        """The points that match in the patches of the superpoints that match."""
        rows, columns = matched_superpoints(
            target.descriptors, source.descriptors, target.mask[:, 0], source.mask[:, 0]
        )
        assignment = self.assigned(target, source, rows, columns)[:, :-1, :-1].exp()
        matched = matched_points(assignment, target.mask[rows], source.mask[columns])
        patch, row, column = matched.nonzero(as_tuple=True)
        return PointMatches(
            target.points[target.patches[rows[patch], row]],
            source.points[source.patches[columns[patch], column]],
            assignment[matched],
            patch,
        )

    def assigned(self, target: Cloud, source: Cloud, rows: Tensor, columns: Tensor) -> Tensor:
        """Logarithms of how the points of pairs of patches are assigned, (b, k + 1, k + 1).

        Args:
            target: with features.
            source: with features.
            rows: (b,) superpoints of the target.
            columns: (b,) superpoints of the source.
        """
        row_features = with_shadow(target.features)[target.patches[rows]]
        column_features = with_shadow(source.features)[source.patches[columns]]
        scores = row_features @ column_features.mT / math.sqrt(row_features.shape[-1])
        logarithms: Tensor = self.optimal_transport(scores, target.mask[rows], source.mask[columns])
        return logarithms


def _cloud(points: Tensor, features: Tensor, superpoints: Tensor, descriptors: Tensor) -> Cloud:
    owned = patches(*(np.asarray(each.cpu()) for each in (points, superpoints)))
    unit = nn.functional.normalize(descriptors, dim=1)
    return Cloud(points, features, superpoints, unit, owned.to(points.device))
