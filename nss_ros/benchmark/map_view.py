"""A map made ready to be looked at: points by stage, z up, walls along x and y."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nss_ros.bag import Log
from nss_ros.benchmark.displacement import alignment
from nss_ros.fragment import FragmentId, Points, voxelize
from nss_ros.geometry import Transform, from_yaw, inverse, transform_points
from nss_ros.multiway.measurement import measurement
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.multiway.spanning_tree import components, spanning_tree_poses

MOST_POINTS = 3_000_000
"""Kept of a view, however large the map is."""

_ABOVE_FLOOR = 0.25, 2.1  # metres: of a slice that shows walls, without floor and ceiling
_VOXEL = 0.03
_AGREE = 0.5  # metres: spots that are in place
_NEAR = 0.8  # metres: a spot that a section passes
_YAW_STEP = 1.0  # degrees
_DIRECTION_FRAGMENTS = 60
_UPRIGHT_POINTS = 50_000
_YAW_BIN = 0.05  # metres

Poses = Mapping[FragmentId, Transform]


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """The fragments of one area that are in one component of the map, in a common frame.

    Attributes:
        area: of the fragments.
        part: number of the component among those of the area, from 1, the largest first.
        parts: components of the area.
        points: (n, 3) by stage, ascending, metres; empty without point clouds.
        spots: where each fragment was taken from, (3,).
        gaps: how far the spots are from their true places after `consensus`, metres; empty
            without ground truth.
        level: z is up, as far as is known; else up is the direction in which the map is thinnest.
    """

    area: str
    points: dict[int, Points]
    spots: dict[FragmentId, NDArray[np.float64]]
    gaps: NDArray[np.float64]
    level: bool
    part: int = 1
    parts: int = 1

    @property
    def name(self) -> str:
        """For people, within a sentence."""
        whole = f"area {self.area}"
        return whole if self.parts == 1 else f"{whole}, component {self.part} of {self.parts}"

    @property
    def title(self) -> str:
        """The name with its number of fragments if there are several components."""
        text = self.name[0].upper() + self.name[1:]
        count = len(self.spots)
        return text if self.parts == 1 else f"{text} ({count:,} fragment{'s' * (count != 1)})"

    @property
    def key(self) -> str:
        """For names of files."""
        return self.area if self.parts == 1 else f"{self.area}_component{self.part}"

    @property
    def stages(self) -> list[int]:
        """Of the fragments, ascending."""
        return sorted({id_.stage for id_ in self.spots})

    def floor(self) -> float:
        """Height of the floor, metres: below it lie only stray points."""
        heights = np.concatenate([points[::7, 2] for points in self.points.values()])
        return float(np.percentile(heights, 2))

    def slice(self) -> tuple[float, float]:
        """Heights between which walls and furniture stand, without floor and ceiling, metres."""
        floor = self.floor()
        return floor + _ABOVE_FLOOR[0], floor + _ABOVE_FLOOR[1]

    def middle(self) -> float:
        """The y of the section that passes most spots nearby, metres.

        Spots may lie outside of what they saw; if all do, the section is in the middle of that.
        """
        points = np.concatenate([points[::7, 1] for points in self.points.values()])
        low, median, high = np.percentile(points, (5, 50, 95))
        y = np.array([spot[1] for spot in self.spots.values()])
        y = y[(y > low) & (y < high)]
        if not len(y):
            return float(median)
        near = np.abs(y[:, None] - y) < _NEAR
        return float(y[near[int(near.sum(axis=1).argmax())]].mean())


def map_views(log: Log) -> list[MapView]:
    """Every component of each area of the map, in the order of areas and then of size."""
    if log.pose_graph is None:
        return []
    areas: dict[str, dict[int, dict[FragmentId, Transform]]] = {}
    for id_, node in log.pose_graph.poses().items():
        components = areas.setdefault(id_.area, {})
        components.setdefault(node.component, {})[id_] = node.T_map_fragment
    return [
        replace(map_view(log, poses), part=number, parts=len(components))
        for _, components in sorted(areas.items())
        for number, (_, poses) in enumerate(
            sorted(components.items(), key=lambda item: (-len(item[1]), item[0])), start=1
        )
    ]


def most_important(views: Sequence[MapView], most: int) -> list[MapView]:
    """So many views, in their order: each area's largest component first, then the largest."""
    ranked = sorted(views, key=lambda view: (view.part > 1, -len(view.spots)))[:most]
    return [view for view in views if any(view is each for each in ranked)]


def chained_view(log: Log, view: MapView) -> MapView | None:
    """The same fragments before the multi-way step: the most confident transforms, chained.

    None if the transforms do not link them all.
    """
    members = sorted(view.spots)
    here = set(members)
    usable = [
        measurement(answer, level=False)
        for pair, answer in sorted(log.relative_transforms.items())
        if answer.ok and pair.source in here and pair.target in here
    ]
    if len(members) < 2 or len(components(members, usable)) != 1:
        return None
    ranks = np.array([(each.confidence, each.inliers) for each in usable], dtype=np.float64)
    before = map_view(log, spanning_tree_poses(members, usable, ranks), view)
    return replace(before, part=view.part, parts=view.parts)


def map_view(log: Log, poses: Poses, like: MapView | None = None) -> MapView:
    """Fragments of one area at some poses.

    Args:
        log: with the point clouds, if there are any, and the ground truth, likewise.
        poses: of fragments of one area, one or more.
        like: a view of the same fragments to be aligned with, where the truth is not known.
    """
    ids = sorted(poses)
    truth = _true_poses(log.ground_truth, ids)
    known = [id_ for id_ in ids if id_ in truth]
    level = all(log.fragments[id_].gravity_aligned for id_ in ids if id_ in log.fragments)
    align, gaps = np.eye(4), np.zeros(0)
    if known:
        estimates, targets = (np.stack([each[id_] for id_ in known]) for each in (poses, truth))
        align = consensus(estimates, targets)
        gaps = _gaps(align, estimates, targets)
        # Of the true points: those of a map that is torn have no direction.
        turn = _upright(_points(log, _some(truth), np.eye(4)), level)
    elif like is not None:
        turn = np.eye(4)
        align = _onto(np.stack([poses[id_][:3, 3] for id_ in ids]),
                      np.stack([like.spots[id_] for id_ in ids]))  # fmt: skip
    else:
        turn = _upright(_points(log, _some(poses), np.eye(4)), level)
    shown = turn @ align
    return MapView(
        ids[0].area,
        _points(log, poses, shown),
        {id_: transform_points(shown, poses[id_][None, :3, 3])[0] for id_ in ids},
        gaps,
        level,
    )


def consensus(poses: NDArray[np.float64], true_poses: NDArray[np.float64]) -> Transform:
    """The rigid transform A with which most of A @ poses are right, and these as well as can be.

    A map that is torn is so shown with its largest whole part in place.

    Args:
        poses: (n, 4, 4), one or more.
        true_poses: (n, 4, 4) of the same fragments.
    """
    best, most = np.eye(4), (-1, 0.0)
    for pose, true_pose in zip(poses, true_poses, strict=True):
        align = true_pose @ inverse(pose)
        gaps = _gaps(align, poses, true_poses)
        agreement = (int((gaps < _AGREE).sum()), -float(np.minimum(gaps, _AGREE).sum()))
        if agreement > most:
            best, most = align, agreement
    near = _gaps(best, poses, true_poses) < _AGREE
    return alignment(poses[near], true_poses[near])


def thinned(points: Mapping[int, Points], most: int) -> dict[int, Points]:
    """Points by stage, voxelised so coarsely that at most so many are left."""
    voxel = _VOXEL
    result = dict(points)
    while sum(len(each) for each in result.values()) > most:
        voxel *= 1.25
        result = {stage: voxelize(each, voxel) for stage, each in points.items()}
    return result


def _points(log: Log, poses: Poses, align: Transform) -> dict[int, Points]:
    here = [id_ for id_ in sorted(poses) if id_ in log.fragments]
    share = max(500, MOST_POINTS // max(len(here), 1))
    parts: dict[int, list[Points]] = {}
    for id_ in here:
        points = log.fragments[id_].points
        points = points[:: -(-len(points) // share) or 1]
        parts.setdefault(id_.stage, []).append(
            transform_points(align @ poses[id_], points).astype(np.float32)
        )
    return {stage: np.concatenate(each) for stage, each in sorted(parts.items())}


def _gaps(
    align: Transform, poses: NDArray[np.float64], true_poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances of aligned spots from their true places, metres."""
    moved = transform_points(align, poses[:, :3, 3])
    return np.asarray(np.linalg.norm(moved - true_poses[:, :3, 3], axis=1))


def _some(poses: Poses) -> Poses:
    """Enough of them to find directions."""
    ids = list(poses)
    return {id_: poses[id_] for id_ in ids[:: -(-len(ids) // _DIRECTION_FRAGMENTS)]}


def _true_poses(graphs: Sequence[PoseGraph], ids: Sequence[FragmentId]) -> Poses:
    """Of the graph that knows most of the fragments: frames of graphs may differ."""
    wanted = set(ids)
    known = [
        {id_: node.T_map_fragment for id_, node in graph.poses().items() if id_ in wanted}
        for graph in graphs
    ]
    return max(known, key=len, default={})


def _onto(spots: NDArray[np.float64], others: NDArray[np.float64]) -> Transform:
    """The rigid transform that brings spots closest to others."""
    center, other = spots.mean(axis=0), others.mean(axis=0)
    u, _, vt = np.linalg.svd((spots - center).T @ (others - other))
    sign = np.diag((1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T)) or 1.0))
    result = np.eye(4)
    result[:3, :3] = vt.T @ sign @ u.T
    result[:3, 3] = other - result[:3, :3] @ center
    return result


def _upright(clouds: Mapping[int, Points], level: bool) -> Transform:
    """The rotation that makes z up and lays most walls along x and y."""
    turn = np.eye(4)
    if not clouds:
        return turn
    points = np.concatenate(list(clouds.values()))
    points = points[:: max(1, len(points) // _UPRIGHT_POINTS)]
    if not level:
        _, axes = np.linalg.eigh(np.cov(points.T.astype(np.float64)))
        up = axes[:, 0] * (1.0 if axes[2, 0] >= 0 else -1.0)
        side = axes[:, 2]
        turn[:3, :3] = np.stack((side, np.cross(up, side), up))
    flat = transform_points(turn, points)[:, :2]
    return from_yaw(np.radians(_wall_yaw(flat)), (0, 0, 0)) @ turn


def _wall_yaw(flat: NDArray[np.float64]) -> float:
    """The yaw in -45..45 degrees after which points pile up most along x and y."""
    best, best_yaw = 0.0, 0.0
    # From no turn at all outwards, so that ties change nothing.
    for yaw in sorted(np.arange(-44.0, 45.0, _YAW_STEP), key=abs):
        angle = np.radians(yaw)
        turned = flat @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        sharpness = 0.0
        for column in turned.T:
            cells = np.floor((column - column.min()) / _YAW_BIN).astype(np.intp)
            sharpness += float(np.square(np.bincount(cells).astype(np.float64)).sum())
        if sharpness > best * 1.001:
            best, best_yaw = sharpness, float(yaw)
    return best_yaw
