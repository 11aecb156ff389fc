"""What registration by learned descriptors shares: matches, RANSAC, refinement as for FPFH."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.config import LearnedConfig, RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Points
from nss_ros.geometry import Transform
from nss_ros.registration.correspondence import CorrespondenceMethod
from nss_ros.registration.features import FragmentSurface
from nss_ros.registration.learned.checkpoint import read_record
from nss_ros.registration.learned.training_record import TrainingRecord
from nss_ros.registration.matching import mutual_matches
from nss_ros.registration.ransac import Matches, ransac

# The squared norm of a descriptor then stays below 2**23.
_STEPS = 2000


@dataclass(frozen=True, slots=True)
class Described:
    """Keypoints of a fragment with learned descriptors.

    Attributes:
        points: (k, 3) float32, metres, sensor frame.
        normals: (k, 3) float32, unit.
        descriptors: (k, c) float32, as `quantised` makes them.
    """

    points: Points
    normals: Points
    descriptors: NDArray[np.float32]


Features = TypeVar("Features", bound=FragmentSurface)


class LearnedMethod(CorrespondenceMethod[Features]):
    """A network describes points; RANSAC finds the transforms on which their matches agree.

    Attributes:
        training: what the weights were trained on, if `nss train` did; else None.

    Raises:
        MethodError: the weights were trained with another voxel size.
    """

    def __init__(self, config: RegistrationConfig, settings: LearnedConfig) -> None:
        super().__init__(config)
        self.inlier_distance = settings.inlier_distance
        self.training = _record(self.name, settings)
        if torch.get_num_threads() != 1:  # pairs are what is done in parallel
            torch.set_num_threads(1)

    def _candidates(self, matches: Matches, level: bool, seed: int) -> list[Transform]:
        fpfh = self.config.fpfh
        found = ransac(
            matches,
            self.inlier_distance,
            fpfh.ransac_iterations,
            fpfh.ransac_confidence,
            seed,
            level and fpfh.use_gravity,
            fpfh.hypotheses,
        )
        return [candidate.T_target_source for candidate in found]


def _record(method: str, settings: LearnedConfig) -> TrainingRecord | None:
    record = read_record(Path(settings.weights)) if settings.weights else None
    if record is not None and record.method == method and record.voxel_size != settings.voxel_size:
        raise MethodError(
            f"{settings.weights} was trained with a voxel size of {record.voxel_size:g} m: set "
            f"registration.{method}.voxel_size to it."
        )
    return record


def matched(source: Described, target: Described) -> Matches:
    """The keypoints of two fragments whose descriptors are each other's nearest."""
    first, second = mutual_matches(source.descriptors, target.descriptors)
    return Matches(
        source.points[first].astype(np.float64),
        target.points[second].astype(np.float64),
        source.normals[first].astype(np.float64),
        target.normals[second].astype(np.float64),
    )


def quantised(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit descriptors (k, c) in whole steps, so that matching them is exact; see `matching`."""
    return np.asarray(np.round(descriptors * _STEPS), dtype=np.float32)


def normals_at(points: Points, surface: FragmentSurface) -> Points:
    """Normals (k, 3) of points (k, 3) of a fragment, those of its nearest voxelised points."""
    if len(points) == 0:
        return np.zeros((0, 3), dtype=np.float32)
    _, nearest = cKDTree(surface.points).query(points)
    return np.asarray(surface.normals[nearest])
