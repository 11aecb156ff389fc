"""What submaps need of a fragment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.registration.gravity.method import feature_maps
from nss_ros.registration.gravity.network import GravityNetwork
from nss_ros.registration.gravity.scan import LevelScan, reaches_far, scan_of


@dataclass(frozen=True, slots=True)
class SubmapFragment:
    """A levelled fragment.

    Attributes:
        id: the fragment.
        points: (n, 3) float32, voxelised, metres, sensor frame.
        normals: (n, 3) float32, unit, towards the sensor.
        floor: height of the floor in the sensor frame, metres.
        maps: (2, CHANNELS, h, w) float16, features for a pair of different stages and of one.
    """

    id: FragmentId
    points: Points
    normals: Points
    floor: float
    maps: NDArray[np.float16]

    @classmethod
    def of(cls, scan: LevelScan, network: GravityNetwork) -> SubmapFragment:
        """A prepared scan with its features."""
        maps = feature_maps(network, scan).astype(np.float16)
        return cls(scan.id, scan.points, scan.normals, scan.floor.height, maps)


def submap_fragment(
    fragment: Fragment, network: GravityNetwork, config: RegistrationConfig
) -> SubmapFragment | None:
    """A fragment as a part of submaps; None if it is not levelled, too small or reaches too far."""
    if not fragment.gravity_aligned or reaches_far(fragment):
        return None
    scan = scan_of(fragment, config)
    return SubmapFragment.of(scan, network) if len(scan.points) >= config.min_points else None
