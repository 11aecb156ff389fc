"""What submaps need of a fragment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.geometry import Transform
from nss_ros.registration.gravity.agreement import SharpView, WallView
from nss_ros.registration.gravity.method import feature_maps
from nss_ros.registration.gravity.network import STRIDE, GravityNetwork
from nss_ros.registration.gravity.raster import CELL, FREE, OCCUPIED, Raster, rasterize
from nss_ros.registration.gravity.scan import LevelScan, fitting_scan_of
from nss_ros.standpoint import at_standpoint

# As a share of how far their maps reach: 7 m for fragments of a Matterport.
_FARTHEST = 7.0 / 4.8


@dataclass(frozen=True, slots=True)
class SubmapFragment:
    """A levelled fragment, in the frame of its standpoint, where its scanner stood.

    Attributes:
        id: the fragment.
        points: (n, 3) float32, voxelised, metres.
        normals: (n, 3) float32, unit, towards the sensor.
        floor: height of the floor, metres.
        maps: (2, CHANNELS, h, w) float16, features for a pair of different stages and of one.
        seen: (h, w) float16, 0..1, how much of each cell its scanner saw.
        view: what its scanner saw, to tell whether what another of its stage saw can be there.
        sharp: the same in more detail, for poses that are aligned.
        network: that made the features.
        standpoint: (4, 4) pose of it in the frame that the fragment came in.
    """

    id: FragmentId
    points: Points
    normals: Points
    floor: float
    maps: NDArray[np.float16]
    seen: NDArray[np.float16]
    view: WallView
    sharp: SharpView
    network: GravityNetwork
    standpoint: Transform

    @classmethod
    def of(cls, scan: LevelScan, network: GravityNetwork, standpoint: Transform) -> SubmapFragment:
        """A prepared scan with its features."""
        return cls(
            scan.id,
            scan.points,
            scan.normals,
            scan.floor.height,
            feature_maps(network, scan.maps).astype(np.float16),
            _seen(scan.maps),
            WallView.of(scan.points, scan.normals),
            SharpView.of(scan.points, scan.normals),
            network,
            standpoint,
        )

    @property
    def reach(self) -> float:
        """How far its maps reach to each side of the sensor, metres."""
        return CELL * STRIDE * int(self.seen.shape[-1]) / 2

    def at_floor(self, height: float) -> SubmapFragment:
        """The fragment with its features by slices above another height.

        Floors are not the same everywhere: what stands on a raised one is seen from a lower one.
        """
        cells = self.seen.shape[-1] * STRIDE
        maps = rasterize(self.points, self.normals, height, cells)
        features = feature_maps(self.network, maps).astype(np.float16)
        return replace(self, floor=height, maps=features, seen=_seen(maps))


Fragments = Mapping[FragmentId, SubmapFragment]


def farthest(one: SubmapFragment, other: SubmapFragment) -> float:
    """Distance, metres, beyond which two fragments hardly see anything together."""
    return _FARTHEST * max(one.reach, other.reach)


def submap_fragment(
    fragment: Fragment, network: GravityNetwork, config: RegistrationConfig
) -> SubmapFragment | None:
    """A fragment as a part of submaps; None if it is not levelled, or too small."""
    if not fragment.gravity_aligned:
        return None
    seen, place = at_standpoint(fragment, config.find_standpoints)
    scan = fitting_scan_of(seen, config)
    if len(scan.points) < config.min_points:
        return None
    return SubmapFragment.of(scan, network, place)


def _seen(maps: Raster) -> NDArray[np.float16]:
    """How much of each cell of the features was seen, occupied or free, at any height."""
    seen = (maps[:, OCCUPIED].astype(np.float32) + maps[:, FREE]).max(axis=0).clip(0, 1)
    cells = len(seen) // STRIDE
    shares = seen.reshape(cells, STRIDE, cells, STRIDE).mean(axis=(1, 3))
    return np.asarray(shares, dtype=np.float16)
