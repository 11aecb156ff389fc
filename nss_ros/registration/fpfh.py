"""Registration by FPFH features: the classical baselines of the benchmark.

`FpfhRansac` and `FpfhFgr` share description, mutual matching, ICP and validation, and differ in
how they find the transform on which the matches agree.
"""

from __future__ import annotations

import numpy as np

from nss_ros.fragment import Fragment
from nss_ros.geometry import Transform
from nss_ros.registration.correspondence import CorrespondenceMethod
from nss_ros.registration.features import FpfhFeatures, describe
from nss_ros.registration.fgr import fast_global_registration
from nss_ros.registration.matching import mutual_matches
from nss_ros.registration.ransac import Matches, ransac


class _Fpfh(CorrespondenceMethod[FpfhFeatures]):
    def prepare(self, fragment: Fragment) -> FpfhFeatures:
        """Voxelised points, normals and FPFH descriptors of a fragment."""
        return describe(fragment, self.config)

    def _matches(self, source: FpfhFeatures, target: FpfhFeatures) -> Matches:
        return matched_keypoints(source, target)


class FpfhRansac(_Fpfh):
    """FPFH, mutual matches, RANSAC, point-to-plane ICP."""

    name = "fpfh_ransac"

    def _candidates(self, matches: Matches, level: bool, seed: int) -> list[Transform]:
        fpfh = self.config.fpfh
        found = ransac(
            matches,
            fpfh.inlier_distance,
            fpfh.ransac_iterations,
            fpfh.ransac_confidence,
            seed,
            level and fpfh.use_gravity,
            fpfh.hypotheses,
        )
        return [candidate.T_target_source for candidate in found]


class FpfhFgr(_Fpfh):
    """FPFH, mutual matches, fast global registration, point-to-plane ICP."""

    name = "fpfh_fgr"

    def _candidates(self, matches: Matches, level: bool, seed: int) -> list[Transform]:  # noqa: ARG002
        fpfh = self.config.fpfh
        found = fast_global_registration(matches, fpfh.inlier_distance, fpfh.fgr_iterations, seed)
        return [] if found is None else [found]


def matched_keypoints(source: FpfhFeatures, target: FpfhFeatures) -> Matches:
    """The keypoints of two fragments whose descriptors are each other's nearest."""
    first, second = mutual_matches(source.descriptors, target.descriptors)
    return Matches(
        source.keypoints[first].astype(np.float64),
        target.keypoints[second].astype(np.float64),
        source.keypoint_normals[first].astype(np.float64),
        target.keypoint_normals[second].astype(np.float64),
    )
