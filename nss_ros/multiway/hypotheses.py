"""Choice among the hypotheses of ambiguous pairs by what other pairs say.

A pair alone often cannot tell one bay of a building from the next, and the right pose is then
among its alternatives. Wrong ones seldom agree with those of other pairs, so each pair gets the
hypothesis on which most of the graph agrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, inverse, relative, rotation_angle
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.spanning_tree import (
    Closeness,
    Poses,
    components,
    spanning_tree_poses,
)
from nss_ros.multiway.triangles import triangle_support

# Of one pair; less probable ones cost time and hardly ever help.
_MOST_HYPOTHESES = 6
_MOST_SEEDS = 60
_SWEEPS = 10


def chosen_hypotheses(measurements: Sequence[Measurement], close: Closeness) -> list[Measurement]:
    """The measurements, each with the hypothesis that fits the others best.

    Those that no hypothesis fits keep the most probable one. The order stays.

    Args:
        measurements: with their alternatives.
        close: when two poses of a fragment agree.
    """
    if not any(m.alternatives for m in measurements):
        return list(measurements)
    spread = [_spread(m, close) for m in measurements]
    poses = _agreed_poses([each for among in spread for each in among], close)
    return [_best(among, poses, close) for among in spread]


def _spread(m: Measurement, close: Closeness) -> list[Measurement]:
    """A measurement for each hypothesis, the most probable first; none close to another."""
    spread = [replace(m, alternatives=())]
    for each in m.alternatives:
        stack = np.array([other.T_target_source for other in spread])
        if not close.agree(each.T_target_source, stack).any():
            hypothesis = replace(
                m,
                T_target_source=each.T_target_source,
                information=each.information,
                confidence=each.probability,
                alternatives=(),
            )
            spread.append(hypothesis)
    return spread[:_MOST_HYPOTHESES]


def _agreed_poses(spread: list[Measurement], close: Closeness) -> Poses:
    """Poses of all fragments, those of a component in the frame of its first one."""
    ids = sorted({id_ for m in spread for id_ in (m.pair.source, m.pair.target)})
    poses: Poses = {}
    for members in components(ids, spread):
        inside = set(members)
        own = [m for m in spread if m.pair.source in inside]
        grown = spanning_tree_poses(members, own, _ranks(own, close), close)
        poses |= _voted(members, own, grown, close)
    return poses


def _ranks(spread: list[Measurement], close: Closeness) -> NDArray[np.float64]:
    """By what a tree is grown; the one that it begins with must be right, so loops are counted."""
    confidence = np.array([m.confidence for m in spread])
    best = np.argsort(-confidence, kind="stable")[:_MOST_SEEDS]
    support = triangle_support(spread, close.translation, close.rotation, best.tolist())
    return np.column_stack(([m.manual for m in spread], support, confidence)).astype(np.float64)


def _voted(
    members: Sequence[FragmentId], spread: list[Measurement], poses: Poses, close: Closeness
) -> Poses:
    """Poses after each fragment went, again and again, where most of its neighbours want it.

    The tree placed a fragment when only some of its neighbours had been placed.
    """
    touching: dict[FragmentId, list[Measurement]] = {id_: [] for id_ in members}
    for m in spread:
        touching[m.pair.source].append(m)
        touching[m.pair.target].append(m)
    poses = dict(poses)
    for _ in range(_SWEEPS):
        changed = False
        for id_ in members:
            predictions = np.array([_prediction(id_, m, poses) for m in touching[id_]])
            votes = close.votes(predictions)
            if votes.max() > close.agree(poses[id_], predictions).sum():
                poses[id_] = predictions[int(np.argmax(votes))]
                changed = True
        if not changed:
            break
    return poses


def _prediction(id_: FragmentId, m: Measurement, poses: Poses) -> Transform:
    if id_ == m.pair.source:
        return poses[m.pair.target] @ m.T_target_source
    return poses[m.pair.source] @ inverse(m.T_target_source)


def _best(among: list[Measurement], poses: Poses, close: Closeness) -> Measurement:
    pair = among[0].pair
    expected = relative(poses[pair.source], poses[pair.target])
    stack = np.array([each.T_target_source for each in among])
    fitting = np.flatnonzero(close.agree(expected, stack))
    if not len(fitting):
        return among[0]
    return min((among[n] for n in fitting), key=lambda each: _misfit(each, expected, close))


def _misfit(m: Measurement, expected: Transform, close: Closeness) -> float:
    error = inverse(m.T_target_source) @ expected
    distance = float(np.linalg.norm(error[:3, 3]))
    return distance / close.translation + rotation_angle(error) / close.rotation
