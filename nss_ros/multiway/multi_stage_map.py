"""The growing map of all stages: what was received, and what a person said about it.

Nothing in here is estimated: the state is a set of fragments, answers, constraints and
exclusions, so it does not depend on the order in which they came.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, Points, voxelize
from nss_ros.geometry import Matrix, Transform, transform_points
from nss_ros.multiway.measurement import measurement
from nss_ros.multiway.pose_graph import (
    Edge,
    EdgeKind,
    EdgeStatus,
    Measurement,
    NodeStatus,
    PoseGraph,
)
from nss_ros.registration.relative_transform import RelativeTransform

# Why an edge is rejected that a person excluded; saved maps are recognised by it.
EXCLUDED = "excluded by remove_constraint"

# A constraint given without a covariance: 0.01 m and 0.2 deg standard deviation.
_SURE = np.diag([0.01**2] * 3 + [np.deg2rad(0.2) ** 2] * 3)


class MultiStageMap:
    """Fragments and relative transforms of all stages.

    Args:
        voxel_size: fragments are voxelised to this on arrival, metres.

    Attributes:
        version: grows with every change that can alter the poses.
        fragments: what was received, voxelised.
        pairs: what was asked for.
        results: the first answer to each pair.
        constraints: given by a person.
    """

    def __init__(self, voxel_size: float) -> None:
        self._voxel_size = voxel_size
        self.version = 0
        self.fragments: dict[FragmentId, Fragment] = {}
        self.pairs: set[FragmentPair] = set()
        self.results: dict[FragmentPair, RelativeTransform] = {}
        self.constraints: dict[FragmentPair, Measurement] = {}
        self._excluded: set[FragmentPair] = set()

    def add_fragment(self, fragment: Fragment) -> bool:
        """Take a fragment in; False if its id is there already."""
        if fragment.id in self.fragments:
            return False
        points = voxelize(fragment.points, self._voxel_size)
        self.fragments[fragment.id] = Fragment(fragment.id, points, fragment.gravity_aligned)
        self.version += 1
        return True

    def add_pair(self, pair: FragmentPair) -> None:
        """Note that an answer to a pair is to be expected."""
        self.pairs.add(pair)

    def add_result(self, result: RelativeTransform) -> bool:
        """Take the answer to a pair in; False if there was one already."""
        if result.pair in self.results:
            return False
        self.results[result.pair] = result
        self.version += 1
        return True

    @property
    def complete(self) -> bool:
        """Whether every pair that was asked for is answered."""
        return self.pairs <= self.results.keys()

    def add_constraint(
        self, pair: FragmentPair, T_target_source: Transform, covariance: Matrix | None = None
    ) -> None:
        """Add a relative transform that is never rejected; replaces one of the same pair.

        Args:
            pair: source and target.
            T_target_source: (4, 4).
            covariance: (6, 6), order x y z rx ry rz (m, rad); None or zero: 0.01 m and 0.2 deg.

        Raises:
            InputError: a fragment is not in the map, or the covariance is not positive definite.
        """
        for id_ in (pair.source, pair.target):
            if id_ not in self.fragments:
                raise InputError(f"Fragment {id_} is not in the map.")
        if covariance is None or not np.any(covariance):
            covariance = _SURE
        try:
            np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError as error:
            raise InputError("The covariance of a constraint must be positive definite.") from error
        self.constraints[pair] = Measurement(
            pair, T_target_source, np.asarray(np.linalg.inv(covariance)), manual=True
        )
        self.version += 1

    def remove_constraint(self, pair: FragmentPair) -> bool:
        """Take a constraint away, or else exclude the pair's answer; False if there is neither."""
        if self.constraints.pop(pair, None) is None:
            if pair not in self.results or pair in self._excluded:
                return False
            self._excluded.add(pair)
        self.version += 1
        return True

    def measurements(self) -> list[Measurement]:
        """Input of the synchronizer: usable answers and constraints, in canonical order."""
        usable = [
            measurement(result, self._level(pair))
            for pair, result in sorted(self.results.items())
            if result.ok and pair not in self._excluded
        ]
        return usable + [self.constraints[pair] for pair in sorted(self.constraints)]

    def unused_edges(self) -> list[Edge]:
        """Edges of the answers that the synchronizer does not get to see."""
        return [
            Edge(
                pair,
                result.T_target_source,
                EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE,
                EdgeStatus.REJECTED if result.ok else EdgeStatus.FAILED,
                EXCLUDED if result.ok else result.message,
                weight=0.0,
                covariance=result.covariance,
            )
            for pair, result in sorted(self.results.items())
            if not result.ok or pair in self._excluded
        ]

    def _level(self, pair: FragmentPair) -> bool:
        ends = (self.fragments.get(pair.source), self.fragments.get(pair.target))
        return all(fragment is not None and fragment.gravity_aligned for fragment in ends)


def merged_points(placed: Iterable[tuple[Fragment, Transform]], voxel_size: float) -> Points:
    """The points (n, 3) of fragments at their poses, one or more, voxelised."""
    clouds = [transform_points(pose, fragment.points) for fragment, pose in placed]
    return voxelize(np.concatenate([cloud.astype(np.float32) for cloud in clouds]), voxel_size)


def map_points(
    fragments: dict[FragmentId, Fragment],
    graph: PoseGraph,
    voxel_size: float,
) -> tuple[Points, NDArray[np.float32]]:
    """The points of the largest component in the map frame.

    Args:
        fragments: by id.
        graph: poses.
        voxel_size: metres; stages are voxelised apart, so that change stays visible.

    Returns:
        Points (n, 3) float32, and their stages (n,) float32.
    """
    by_stage: dict[int, list[tuple[Fragment, Transform]]] = {}
    for node in graph.nodes:
        placed = node.status is NodeStatus.PLACED and node.component == 0
        if placed and node.id in fragments:
            placed_fragment = fragments[node.id], node.T_map_fragment
            by_stage.setdefault(node.id.stage, []).append(placed_fragment)
    clouds = [np.zeros((0, 3), np.float32)]
    stages = [np.zeros(0, np.float32)]
    for number in sorted(by_stage):
        cloud = merged_points(by_stage[number], voxel_size)
        clouds.append(cloud)
        stages.append(np.full(len(cloud), number, np.float32))
    return np.concatenate(clouds), np.concatenate(stages)
