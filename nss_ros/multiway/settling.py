"""Fragments of a submap, moved to where they fit all others best.

A fragment that was placed by a pair may have slid along a wall, a few decimetres, and carried
others of its stage with it: a jamb or the end of a wall that would tell lies beyond the reach of
an alignment that studs must not mislead. All that stands around tells it, so each stage and then
each fragment is aligned with its surroundings from farther away, and stays where these do not
agree more.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, relative, rotation_angle, transform_points
from nss_ros.icp import Surface, refine
from nss_ros.multiway.spanning_tree import Poses
from nss_ros.multiway.submap_fragment import Fragments, farthest
from nss_ros.registration.fit import fit

_ROUNDS = 3
# Fragments around one that are looked at, the nearest, and which of their points, each so many:
# enough that a surface of theirs has one nearer than `_FITTING` everywhere.
_AROUND, _STEP = 12, 4
# Points that are moved; few tell whether anything moves at all, which is mostly not so.
_MOVED_POINTS, _FEW_POINTS = 2000, 600
_DISTANCE, _KERNEL, _DAMPING = 0.4, 0.2, 0.001
_ITERATIONS, _FEW_ITERATIONS = 15, 6
# Points of walls this near may lie on what is around; the share that does must grow by so much.
_FITTING, _LEAST_GAIN = 0.1, 0.004
# Less is left to the optimisation of the pose graph, more is another place.
_LEAST_MOVE, _MOST_MOVE, _MOST_ROTATION = 0.03, 0.6, np.radians(6)


@dataclass(frozen=True, slots=True)
class _Body:
    """Fragments that are moved as one.

    Attributes:
        pose: of its frame, in which the points are.
        moved: some of its points.
        few: fewer of them.
    """

    pose: Transform
    moved: Surface
    few: Surface

    @classmethod
    def of(cls, ids: Sequence[FragmentId], poses: Poses, fragments: Fragments) -> _Body:
        """The body of fragments, in a frame in the middle of them."""
        pose = np.eye(4)
        pose[:3, 3] = np.mean([poses[id_][:3, 3] for id_ in ids], axis=0)
        local = {id_: relative(poses[id_], pose) for id_ in ids}
        whole = _surface(ids, local, fragments)
        few, moved = (
            Surface.sample(whole.points, whole.normals, count)
            for count in (_FEW_POINTS, _MOVED_POINTS)
        )
        return cls(pose, moved, few)


def settled(part: Poses, fragments: Fragments, held: Collection[FragmentId] = ()) -> Poses:
    """The poses of a submap, after each stage and each fragment was aligned with all around it.

    Args:
        part: poses of the fragments.
        fragments: prepared.
        held: fragments that stay where they are.
    """
    return _settled_fragments(_settled_stages(part, fragments, held), fragments, held)


def _settled_stages(part: Poses, fragments: Fragments, held: Collection[FragmentId]) -> Poses:
    """Each stage as a whole against the others, the smallest first."""
    poses = dict(part)
    stages: dict[int, list[FragmentId]] = {}
    for id_ in sorted(part):
        stages.setdefault(id_.stage, []).append(id_)
    for stage, ids in sorted(stages.items(), key=lambda each: (len(each[1]), each[0])):
        others = [id_ for id_ in sorted(part) if id_.stage != stage]
        if not others or any(id_ in held for id_ in ids):
            continue
        body = _Body.of(ids, poses, fragments)
        target = _surface(others, poses, fragments)
        move = _fitting(body, [target], target) @ np.linalg.inv(body.pose)
        poses |= {id_: move @ poses[id_] for id_ in ids}
    return poses


def _settled_fragments(part: Poses, fragments: Fragments, held: Collection[FragmentId]) -> Poses:
    """Each fragment against those around it, those that fit worst first."""
    poses = dict(part)
    around = {id_: _around(id_, part, fragments) for id_ in sorted(part)}
    waiting = {id_ for id_, others in around.items() if others}
    for _ in range(_ROUNDS):
        shares = {}
        for id_ in sorted(waiting.difference(held)):
            body = _Body.of([id_], poses, fragments)
            shares[id_] = _share(body.few, body.pose, _surface(around[id_], poses, fragments))
        waiting = set()
        for id_ in sorted(shares, key=lambda each: (shares[each], each)):
            body = _Body.of([id_], poses, fragments)
            everything = _surface(around[id_], poses, fragments)
            targets = [everything]
            # Those of its own stage may have slid along with it.
            others = [other for other in around[id_] if other.stage != id_.stage]
            if 0 < len(others) < len(around[id_]):
                targets.append(_surface(others, poses, fragments))
            pose = _fitting(body, targets, everything)
            if pose is not body.pose:
                poses[id_] = pose @ relative(poses[id_], body.pose)
                waiting.update(around[id_])
    return poses


def _around(id_: FragmentId, part: Poses, fragments: Fragments) -> list[FragmentId]:
    """The nearest of the other fragments that see something of what one sees."""
    distances = [
        (float(np.linalg.norm((part[other] - part[id_])[:2, 3])), other)
        for other in part
        if other != id_
    ]
    near = [
        other
        for distance, other in sorted(distances)
        if distance < farthest(fragments[id_], fragments[other])
    ]
    return near[:_AROUND]


def _fitting(body: _Body, targets: Sequence[Surface], everything: Surface) -> Transform:
    """The pose of a body, near its own, where most of it lies on what is around it.

    Args:
        body: what is moved.
        targets: with which it is aligned, in turn.
        everything: around it.
    """
    best, most = body.pose, _share(body.moved, body.pose, everything) + _LEAST_GAIN
    for target in targets:
        pose = _aligned(body.few, target, body.pose, _FEW_ITERATIONS)
        if np.linalg.norm((pose - body.pose)[:3, 3]) < _LEAST_MOVE:
            continue
        pose = _aligned(body.moved, target, pose, _ITERATIONS)
        if not _is_move(pose, body.pose):
            continue
        share = _share(body.moved, pose, everything)
        if share > most:
            best, most = pose, share
    return best


def _aligned(moved: Surface, target: Surface, start: Transform, iterations: int) -> Transform:
    refined = refine(moved, target, start, _DISTANCE, iterations, (1.0,), _KERNEL, _DAMPING)
    return refined.T_target_source


def _is_move(pose: Transform, start: Transform) -> bool:
    distance = float(np.linalg.norm((pose - start)[:3, 3]))
    angle = rotation_angle(relative(pose, start))
    return _LEAST_MOVE < distance < _MOST_MOVE and angle < _MOST_ROTATION


def _surface(ids: Sequence[FragmentId], poses: Poses, fragments: Fragments) -> Surface:
    """Some of the points of fragments in one frame."""
    points, normals = [], []
    for id_ in ids:
        fragment, pose = fragments[id_], poses[id_]
        points.append(transform_points(pose, fragment.points[::_STEP].astype(np.float64)))
        normals.append(fragment.normals[::_STEP].astype(np.float64) @ pose[:3, :3].T)
    return Surface.of(np.concatenate(points), np.concatenate(normals))


def _share(surface: Surface, pose: Transform, target: Surface) -> float:
    """Share of the points that lie on walls of the target."""
    return fit(surface, target, pose, _FITTING)
