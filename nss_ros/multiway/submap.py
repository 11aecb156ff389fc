"""Submaps: fragments that are placed in one frame, registered as if they were one large fragment.

What several fragments saw together is hardly ambiguous, where each alone is (the paper found that
12 m of context aligns better than single fragments). Two submaps are registered by the hypotheses
of the pairs between them and by an exhaustive search; all poses are scored by the learned features
of all that they saw, so pairs count that nobody asked for, and free space that contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId
from nss_ros.geometry import (
    Transform,
    from_yaw,
    inverse,
    relative,
    rotation_angle,
    transform_points,
)
from nss_ros.icp import Surface, refine
from nss_ros.multiway.agglomeration import LARGE, Ambiguous, Votes
from nss_ros.multiway.contradictions import loss_of_parts, nearest_pairs
from nss_ros.multiway.spacing import count_on_same_place
from nss_ros.multiway.spanning_tree import Closeness, Poses
from nss_ros.multiway.submap_fragment import Fragments, SubmapFragment
from nss_ros.registration.fit import fit
from nss_ros.registration.gravity.agreement import agreement
from nss_ros.registration.gravity.canvas import Canvas, canvas_score, canvas_search
from nss_ros.registration.gravity.wide import evening

# Points of a submap: of its surface, and of what is moved in ICP.
_VOXEL_SIZE = 0.1
# Slices of a fragment whose floor is farther from that of its submap, metres, are made anew.
_SAME_FLOOR = 0.04
_MOVED_POINTS = 1500
# Poses that are scored, from the pairs and from the search; those that are aligned.
_FROM_PAIRS, _FROM_SEARCH, _MOST_ALIGNED = 12, 20, 6
_MOST_MARGIN = 10.0
_ICP_DISTANCE, _ICP_ITERATIONS, _KERNEL, _DAMPING = 0.15, 8, 0.05, 0.005
# An alignment that goes farther was carried away.
_MOST_TRANSLATION, _MOST_ROTATION = 0.6, np.radians(6)
# Pairs share what they saw with the canvases, so what they say counts half.
_PAIRS_WEIGHT = 0.5
# Nearby is so far along each axis, metres; what it counts if all of the points fit.
_NEARBY, _FIT_WEIGHT = 0.3, 100.0
# Where a building repeats, many pairs are wrong alike: for large submaps, which have many pairs,
# what these say together has a limit.
_MOST_BY_PAIRS = 8.0
# Score of having nothing in common: many poses are tried, and the best of them scores something.
_NOTHING = 10.0
# Within a stage nothing moves: points in what others saw to be empty, more than some by the noise
# of the sensor, speak against a pose. Of each pose the nearest pairs of fragments are looked at.
_CONFLICT_WEIGHT, NO_CONFLICT = 150.0, 0.02
_MOST_VIEWS = 6
# A fragment may itself be misplaced, slid along a wall for example: what each takes at most.
_MOST_BY_WITNESS = 8.0
# Scans that reach far see more of each other, so that a wrong place is a smaller share of it.
_WIDE_WEIGHT, WIDE_NONE = 600.0, 0.005


@dataclass(frozen=True, slots=True)
class Submap:
    """Fragments in one frame.

    Attributes:
        poses: of the fragments.
        canvas: their features.
        surface: all points.
        moved: some of them.
        floor: height above which the slices of the features are, metres.
        cells: along each side of the features of a fragment, the median.
        scans: its fragments.
    """

    poses: Poses
    canvas: Canvas
    surface: Surface
    moved: Surface
    floor: float
    cells: int
    scans: Fragments

    @classmethod
    def of(cls, poses: Poses, fragments: Fragments) -> Submap:
        """A submap of fragments with features."""
        floor = float(np.median([pose[2, 3] + fragments[id_].floor for id_, pose in poses.items()]))
        canvas = Canvas.of(poses, _on_floor(poses, fragments, floor))
        return cls._with(poses, canvas, floor, fragments)

    def joined(self, other: Submap, T_self_other: Transform, fragments: Fragments) -> Submap:
        """This submap with the fragments of another."""
        added = {id_: T_self_other @ pose for id_, pose in other.poses.items()}
        canvas = self.canvas.extended(added, _on_floor(added, fragments, self.floor))
        return self._with(self.poses | added, canvas, self.floor, fragments)

    @classmethod
    def _with(cls, poses: Poses, canvas: Canvas, floor: float, fragments: Fragments) -> Submap:
        points, normals = [], []
        for id_, pose in poses.items():
            points.append(transform_points(pose, fragments[id_].points))
            normals.append(fragments[id_].normals @ pose[:3, :3].T)
        cloud, directions = np.concatenate(points), np.concatenate(normals)
        kept = _voxels(cloud)
        cloud, directions = cloud[kept], directions[kept]
        moved = Surface.sample(cloud, directions, _MOVED_POINTS)
        scans = {id_: fragments[id_] for id_ in poses}
        cells = int(np.median([fragments[id_].seen.shape[-1] for id_ in poses]))
        return cls(poses, canvas, Surface.of(cloud, directions), moved, floor, cells, scans)


def _on_floor(poses: Poses, fragments: Fragments, floor: float) -> dict[FragmentId, SubmapFragment]:
    """The fragments, seen by slices above one floor."""
    seen = {}
    for id_, pose in poses.items():
        height = floor - float(pose[2, 3])
        fragment = fragments[id_]
        other = abs(height - fragment.floor) > _SAME_FLOOR
        seen[id_] = fragment.at_floor(height) if other else fragment
    return seen


def _voxels(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Numbers of one point in each voxel."""
    cells = np.floor(points / _VOXEL_SIZE).astype(np.int64)
    cells -= cells.min(axis=0)
    shape = cells.max(axis=0) + 1
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    return np.unique(keys, return_index=True)[1]


@dataclass(frozen=True, slots=True)
class SubmapLink:
    """The best transform between two submaps.

    Attributes:
        odds: logarithm of the odds that it is right, against all others that were found and
            against none; infinite where a person said so.
        T_target_source: (4, 4).
    """

    odds: float
    T_target_source: Transform


def register_submaps(
    source: Submap,
    target: Submap,
    pairs: Sequence[Ambiguous],
    close: Closeness,
    noise: float = 0.0,
    same_place_loss: float = 0.0,
) -> SubmapLink:
    """The best transform between two submaps.

    Args:
        source: one.
        target: another.
        pairs: with a fragment in each, may be none.
        close: when two transforms agree.
        noise: of contradictions, see `noise_of`.
        same_place_loss: of two fragments of one stage, see `loss_on_same_place`.
    """
    if len(source.poses) > len(target.poses):
        link = register_submaps(target, source, pairs, close, noise, same_place_loss)
        return SubmapLink(link.odds, inverse(link.T_target_source))
    votes = Votes.of(target.poses, source.poses, pairs) if pairs else None
    candidates = _candidates(source, target, votes, close)
    obeyed = 0
    if votes is not None:
        counts = votes.obeyed(votes.agreement(np.array(candidates), close))
        obeyed = int(counts.max())
        candidates = [candidates[each] for each in np.flatnonzero(counts == obeyed)]
    score_of = _Scoring(source, target, votes, close, same_place_loss)
    scored = [(score_of(each), each) for each in candidates]
    scored.sort(key=lambda each: -each[0])
    scans = {**source.scans, **target.scans}
    aligned: list[tuple[float, Transform]] = []
    while scored and len(aligned) < _MOST_ALIGNED:
        score, transform = scored[0]
        if aligned and score < max(best for best, _ in aligned) - _MOST_MARGIN:
            break
        score, transform = _aligned(score_of, transform, score)
        contradiction = loss_of_parts(target.poses, source.poses, transform, scans, noise)
        if contradiction > 0:
            score = score_of(transform, contradiction)
        aligned.append((score, transform))
        del scored[0]
    # What was not aligned is a rival only, whatever its score.
    apart = _apart([*sorted(aligned, key=lambda each: -each[0]), *scored], close)
    rivals = [_NOTHING, *(score for score, _ in apart[1:])]
    score, transform = apart[0]
    odds = np.inf if obeyed else score - float(np.logaddexp.reduce(rivals))
    return SubmapLink(odds, transform)


def polished(
    link: SubmapLink,
    source: Submap,
    target: Submap,
    pairs: Sequence[Ambiguous],
    close: Closeness,
    same_place_loss: float = 0.0,
) -> SubmapLink:
    """The link where surfaces lie on each other best nearby; one by a person stays as it is.

    The cells of the features are too wide to tell one side of a thin wall from the other, and ICP
    does not come from there.

    Args:
        link: of the two submaps.
        source: one.
        target: another.
        pairs: with a fragment in each, may be none.
        close: when two transforms agree.
        same_place_loss: of two fragments of one stage, see `loss_on_same_place`.
    """
    if not np.isfinite(link.odds):
        return link
    if len(source.poses) > len(target.poses):
        back = SubmapLink(link.odds, inverse(link.T_target_source))
        back = polished(back, target, source, pairs, close, same_place_loss)
        return SubmapLink(back.odds, inverse(back.T_target_source))
    votes = Votes.of(target.poses, source.poses, pairs) if pairs else None
    score_of = _Scoring(source, target, votes, close, same_place_loss)
    there = link.T_target_source
    found = [(score_of(there) + _FIT_WEIGHT * _fit(source, target, there), there)]
    for shift in product((-_NEARBY, 0.0, _NEARBY), repeat=2):
        start = there.copy()
        start[:2, 3] += shift
        score, transform = _aligned(score_of, start, -np.inf)
        found.append((score + _FIT_WEIGHT * _fit(source, target, transform), transform))
    return SubmapLink(link.odds, max(found, key=lambda each: each[0])[1])


def _fit(source: Submap, target: Submap, transform: Transform) -> float:
    return fit(source.moved, target.surface, transform, _ICP_DISTANCE)


def _candidates(
    source: Submap, target: Submap, votes: Votes | None, close: Closeness
) -> list[Transform]:
    """Transforms from the pairs, and from the search at their height or that of the floors."""
    found: list[Transform] = []
    height = target.floor - source.floor
    if votes is not None:
        scores = votes.scores(votes.agreement(votes.transforms, close)) + 1e-3 * votes.weights
        order = np.argsort(-scores, kind="stable")
        found = _distinct([votes.transforms[each] for each in order], close)[:_FROM_PAIRS]
        # A transform about an origin far away: its height is that of the fragments, not its z.
        height = float(np.median([each[2, 3] for each in found]))
    for transform in canvas_search(source.canvas, target.canvas, _FROM_SEARCH):
        transform[2, 3] = height
        found.append(transform)
    return _distinct(found, close)


def _distinct(transforms: Sequence[Transform], close: Closeness) -> list[Transform]:
    return [each for _, each in _apart([(0.0, each) for each in transforms], close)]


def _apart(
    ranked: Sequence[tuple[float, Transform]], close: Closeness
) -> list[tuple[float, Transform]]:
    """Those that are not close to an earlier one."""
    kept: list[tuple[float, Transform]] = []
    for score, transform in ranked:
        if not kept or not close.agree(transform, np.array([each for _, each in kept])).any():
            kept.append((score, transform))
    return kept


@dataclass(frozen=True, slots=True)
class _Scoring:
    """Scores poses of a source on a target, logarithm.

    Attributes:
        source: what is moved.
        target: on which.
        votes: of the pairs between them, if there are any.
        close: when two transforms agree.
        same_place_loss: of two fragments of one stage.
    """

    source: Submap
    target: Submap
    votes: Votes | None
    close: Closeness
    same_place_loss: float

    def __call__(self, transform: Transform, contradiction: float = 0.0) -> float:
        source, target = self.source, self.target
        share = evening(source.cells, target.cells)
        score = share * canvas_score(source.canvas, target.canvas, transform)
        score -= self._by_views(transform, contradiction, wide=share < 1)
        score -= self.same_place_loss * count_on_same_place(target.poses, source.poses, transform)
        return score + self._by_pairs(transform)

    def _by_views(self, transform: Transform, contradiction: float, *, wide: bool) -> float:
        """What is lost by what scanners of one stage see of each other."""
        target, source = self.target, self.source
        scans = {**source.scans, **target.scans}
        near = nearest_pairs(target.poses, source.poses, transform, scans, _MOST_VIEWS)
        loss = contradiction + conflict_loss(
            _conflict(self.source, self.target, transform, near), wide=wide
        )
        sources, targets = ({pair[n] for pair in near} for n in range(2))
        # All of the source is misplaced if the link is wrong.
        all_of_it = len(sources) == len(self.source.poses)
        witnesses = len(targets) if all_of_it else min(len(sources), len(targets))
        return loss if wide else min(loss, _MOST_BY_WITNESS * witnesses)

    def _by_pairs(self, transform: Transform) -> float:
        if self.votes is None:
            return 0.0
        agree = self.votes.agreement(transform[None], self.close)
        gain = float(self.votes.scores(agree)[0] - self.votes.doubts.sum())
        large = min(len(self.source.poses), len(self.target.poses)) >= LARGE
        return min(_PAIRS_WEIGHT * gain, _MOST_BY_PAIRS if large else np.inf)


def conflict_loss(conflict: float, wide: bool) -> float:
    """What a conflict within a stage takes from the score of a pose, logarithm.

    Args:
        conflict: share of what scanners see of each other's walls that cannot be there.
        wide: they reach far.
    """
    weight, none = (_WIDE_WEIGHT, WIDE_NONE) if wide else (_CONFLICT_WEIGHT, NO_CONFLICT)
    return weight * max(conflict - none, 0.0)


def _conflict(
    source: Submap,
    target: Submap,
    transform: Transform,
    near: Sequence[tuple[FragmentId, FragmentId]],
) -> float:
    """Share of what these see of each other's walls that cannot be there."""
    free = shared = 0.0
    for id_, other in near:
        pair = relative(transform @ source.poses[id_], target.poses[other])
        seen = agreement(source.scans[id_].view, target.scans[other].view, pair)
        free, shared = free + seen.free, shared + seen.shared
    return free / (free + shared) if free else 0.0


def _aligned(score_of: _Scoring, start: Transform, score: float) -> tuple[float, Transform]:
    """The transform after ICP where that scores more, level again, with its score."""
    source = score_of.source
    refined = refine(
        source.moved,
        score_of.target.surface,
        start,
        _ICP_DISTANCE,
        _ICP_ITERATIONS,
        (1.0,),
        _KERNEL,
        _DAMPING,
    ).T_target_source
    level = from_yaw(float(np.arctan2(refined[1, 0], refined[0, 0])), refined[:3, 3])
    # Turned about the middle of the source, not about its origin.
    middle = source.moved.points.mean(axis=0)
    level[:3, 3] += (
        refined[:3, :3] @ middle + refined[:3, 3] - level[:3, :3] @ middle - level[:3, 3]
    )
    moved = relative(level, start)
    distance = np.linalg.norm(moved[:3, :3] @ middle + moved[:3, 3] - middle)
    if distance > _MOST_TRANSLATION or rotation_angle(moved) > _MOST_ROTATION:
        return score, start
    again = score_of(level)
    return (again, level) if again > score else (score, start)
