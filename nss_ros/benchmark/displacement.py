"""How far a map moves one stage against another: what decides whether changes can be read off it.

For stages a and b of one area in one graph: the rigid transform A that brings the estimated
poses of a's fragments closest to the true ones moves those of b too, and the displacement of a
fragment j of b is |A t_j - t*_j|. A minimises the squared distances of the fragments' origins and
of the tips of their unit axes, so one fragment is enough and many decide by where they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from nss_ros.benchmark.evaluation import Placements
from nss_ros.benchmark.metrics import Floats
from nss_ros.geometry import Transform, from_rotation, transform_points


@dataclass(frozen=True, slots=True)
class StageDisplacement:
    """Displacement of a later stage of an area relative to an earlier one.

    Attributes:
        area: of both stages.
        stage: the earlier one, which is held.
        other: the later one, whose fragments are displaced.
        fragments: of the later stage that are in their graph's main component with some of the
            earlier one; a fragment counts once for each graph.
        median: of their displacements, metres.
        largest: of their displacements, metres.
    """

    area: str
    stage: int
    other: int
    fragments: int
    median: float
    largest: float


def stage_displacements(placements: Placements) -> tuple[StageDisplacement, ...]:
    """Displacements of all pairs of stages in the main components, by area and stages."""
    found: dict[tuple[str, int, int], list[float]] = {}
    known = placements.placed & ~np.isnan(placements.T_true[:, 0, 0])
    members: dict[tuple[int, str], dict[int, list[int]]] = {}
    for i in np.flatnonzero(known):
        id_ = placements.ids[i]
        stages = members.setdefault((int(placements.graph[i]), id_.area), {})
        stages.setdefault(id_.stage, []).append(int(i))
    for (_, area), stages in members.items():
        for stage, other in combinations(sorted(stages), 2):
            held, moved = stages[stage], stages[other]
            align = alignment(placements.T_map_fragment[held], placements.T_true[held])
            origins = transform_points(align, placements.T_map_fragment[moved][:, :3, 3])
            distances = np.linalg.norm(origins - placements.T_true[moved][:, :3, 3], axis=1)
            found.setdefault((area, stage, other), []).extend(distances.tolist())
    return tuple(
        StageDisplacement(*key, len(values), float(np.median(values)), max(values))
        for key, values in sorted(found.items())
    )


def alignment(poses: Floats, true_poses: Floats) -> Transform:
    """The rigid transform A that brings A @ poses closest to the true poses; see the module.

    Args:
        poses: (n, 4, 4), one or more.
        true_poses: (n, 4, 4) of the same fragments.
    """
    moved, fixed = _tips(poses), _tips(true_poses)
    center, true_center = moved.mean(axis=0), fixed.mean(axis=0)
    rotation, _ = Rotation.align_vectors(fixed - true_center, moved - center)
    return from_rotation(rotation, true_center - rotation.apply(center))


def _tips(poses: Floats) -> Floats:
    """Origins of the poses and the tips of their unit axes, (4 n, 3)."""
    origins = poses[:, None, :3, 3]
    axes = np.swapaxes(poses[:, :3, :3], 1, 2)
    return np.concatenate((origins, origins + axes), axis=1).reshape(-1, 3)
