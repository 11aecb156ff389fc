"""KISS-Matcher (Lim et al., ICRA 2025) with GICP: the training-free state of the art as a baseline.

FasterPFH describes and matches all points, the k-core of their compatibility graph (ROBIN) prunes
the matches, and graduated non-convexity finds the transform on which the rest agree: for levelled
fragments yaw and translation only (Quatro), else all six degrees of freedom. The library draws
nothing at random, so the seed has no part.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.config import KissMatcherConfig, RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, Points, voxelize
from nss_ros.geometry import Transform, is_transform
from nss_ros.icp import Refined, Surface, refine
from nss_ros.registration.correspondence import CorrespondenceMethod
from nss_ros.registration.features import FragmentSurface, surface_of, viewpoint_of
from nss_ros.registration.gicp import gicp, load_small_gicp
from nss_ros.registration.ransac import Matches

# As the library has it: radii of normals and descriptors in voxels, and the fewest neighbours.
_NORMAL_REACH, _FEATURE_REACH = 3.0, 5.0
_FEWEST_NEIGHBOURS = 3
_FEWEST_MATCHES = 3


@dataclass(frozen=True, slots=True)
class KissFeatures(FragmentSurface):
    """What the method keeps of a fragment; the library describes anew for each pair.

    Attributes:
        viewpoint: (3,) the surfaces face it, metres, sensor frame.
        keypoints: (k, 3) float32, voxelised points that are described, metres, from the
            viewpoint; none if the library cannot describe any.
    """

    viewpoint: NDArray[np.float64]
    keypoints: Points


class KissMatcher(CorrespondenceMethod[KissFeatures]):
    """FasterPFH, graph pruning, graduated non-convexity, GICP."""

    name = "kiss_matcher"

    def __init__(self, config: RegistrationConfig) -> None:
        super().__init__(config)
        self.inlier_distance = config.kiss_matcher.voxel_size
        load_library()
        load_small_gicp()

    def prepare(self, fragment: Fragment) -> KissFeatures:
        """Voxelised points with normals, and the points that will be described."""
        surface = surface_of(fragment, self.config)
        size = self.config.kiss_matcher.voxel_size
        viewpoint = viewpoint_of(surface.gravity_aligned, surface.points)
        keypoints = voxelize(surface.points - viewpoint, size)
        return KissFeatures(
            surface.id,
            surface.gravity_aligned,
            surface.points,
            surface.normals,
            viewpoint,
            keypoints if can_be_described(keypoints, size) else keypoints[:0],
        )

    def _matches(self, source: KissFeatures, target: KissFeatures) -> Matches:
        """The matches that are left after pruning."""
        if not len(source.keypoints) or not len(target.keypoints):
            return Matches(*(np.zeros((0, 3)) for _ in range(4)))
        matcher = _matcher(self.config.kiss_matcher, level=False)
        found = matcher.match(*(each.keypoints.astype(np.float64).T for each in (source, target)))
        first, second = (
            np.array(points, dtype=np.float64).reshape(-1, 3) + each.viewpoint
            for points, each in zip(found, (source, target), strict=True)
        )
        return Matches(first, second, _normals_at(source, first), _normals_at(target, second))

    def _candidates(self, matches: Matches, level: bool, seed: int) -> list[Transform]:  # noqa: ARG002
        settings = self.config.kiss_matcher
        if len(matches) < _FEWEST_MATCHES:
            return []
        matcher = _matcher(settings, level and settings.yaw_only)
        solution = matcher.solve(matches.source.T, matches.target.T)
        transform = np.eye(4)
        transform[:3, :3] = solution.rotation
        transform[:3, 3] = np.ravel(solution.translation)
        agreeing = matcher.get_num_final_inliers()
        if agreeing < settings.min_inliers or not is_transform(transform):
            return []
        return [transform]

    def _refined(
        self,
        source: KissFeatures,
        target: KissFeatures,
        moving: Surface,
        still: Surface,
        start: Transform,
    ) -> Refined:
        """GICP of all points; covariance, residuals and correspondences as with our own ICP."""
        icp = self.config.icp
        found = gicp(source.points, target.points, start, icp.max_distance, icp.iterations)
        return refine(moving, still, found, icp.max_distance, iterations=0)


def can_be_described(points: Points, voxel_size: float) -> bool:
    """Whether FasterPFH finds a descriptor of any point; if not, it crashes the process.

    It needs a few neighbours for a normal, and a few normals for a descriptor.

    Args:
        points: (n, 3), one per voxel, metres.
        voxel_size: metres.
    """
    for reach in (_NORMAL_REACH, _FEATURE_REACH):
        if len(points) == 0:
            break
        tree = cKDTree(points)
        radius = 0.999 * reach * voxel_size  # it rounds to float32
        neighbours = tree.query_ball_point(points, radius, return_length=True)
        points = points[neighbours >= _FEWEST_NEIGHBOURS]
    return len(points) > 0


@cache
def load_library() -> Any:
    """The module kiss_matcher, made to compute with one thread.

    It divides its work among as many threads as there are cores, which no setting changes, and
    they race for bits of one word: the answer may differ from run to run. How many threads there
    are is decided at the first use, by the cores that the main thread may use.

    Raises:
        MethodError: it is not installed.
    """
    try:
        import kiss_matcher
    except ImportError as error:
        raise MethodError(
            "The method 'kiss_matcher' needs the package kiss-matcher: pip install kiss-matcher."
        ) from error
    main_thread = os.getpid()
    cores = os.sched_getaffinity(main_thread)
    os.sched_setaffinity(main_thread, {min(cores)})
    try:
        corner = np.indices((4, 4, 4), dtype=np.float64).reshape(3, -1)
        kiss_matcher.KISSMatcher(1.0).match(corner, corner)
    finally:
        os.sched_setaffinity(main_thread, cores)
    return kiss_matcher


def _matcher(settings: KissMatcherConfig, level: bool) -> Any:
    """A matcher that solves for yaw and translation, or for all.

    The library's solver of yaw keeps the tolerance of the first that a process makes, so voxel
    sizes are only to be compared in processes of their own.
    """
    library = load_library()
    return library.KISSMatcher(
        library.KISSMatcherConfig(
            voxel_size=settings.voxel_size,
            use_voxel_sampling=False,  # ours, which is reproducible and has no limits
            use_quatro=level,
            num_max_corr=settings.max_matches,
            normal_r_gain=_NORMAL_REACH,
            fpfh_r_gain=_FEATURE_REACH,
        )
    )


def _normals_at(surface: FragmentSurface, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normal of the point nearest to each position, (m, 3)."""
    if len(positions) == 0:
        return np.zeros((0, 3))
    _, nearest = cKDTree(surface.points).query(positions)
    return np.asarray(surface.normals[nearest], dtype=np.float64)
