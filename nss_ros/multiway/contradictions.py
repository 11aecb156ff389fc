"""What fragments of one stage see of each other, where poses put them, speaks against the poses.

Within a stage nothing moves. Where rooms are alike, pairs agree on a wrong one; but a thing that
stands where another scanner saw that nothing is tells, also of fragments of which nobody asked for
a pair.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, relative
from nss_ros.multiway.spanning_tree import Poses
from nss_ros.multiway.submap_fragment import Fragments, SubmapFragment
from nss_ros.registration.gravity.agreement import contradiction
from nss_ros.registration.gravity.wide import evening

# What a contradiction takes, logarithm of the odds, and the share that is noise: of hypotheses of a
# hospital whose wards are alike, with confidences above 0.8, half of the wrong ones have more than
# 0.008, and three of 100 right ones more than 0.003.
_WEIGHT, _NONE, _MOST = 250.0, 0.004, 6.0
# The largest of many is noise more often.
_LARGEST_NONE, _MOST_LARGEST = 0.008, 8.0
# People about the scanner are things, too. The median of pairs that are probably right is 0 without
# them; with one in each scan of the bundled bag it is 0.005, and 95 of 100 true pairs have less
# than ten times that. So much of it is taken for noise of a pair, and of the largest of many.
_NOISE, _LARGEST_NOISE = 2.0, 8.0
# Pairs of fragments that are looked at, those nearest each other, and how far apart they may be, as
# a share of how far their maps reach: 6 m for fragments of a Matterport.
_MOST_PAIRS, _FARTHEST = 12, 6.0 / 4.8


def noise_of(
    placed: Iterable[tuple[SubmapFragment, SubmapFragment, Transform]],
) -> float:
    """What pairs that are probably right have of contradictions, the median share; 0 of none.

    Args:
        placed: source, target and `T_target_source` of each pair within a stage.
    """
    shares = [contradiction(one.sharp, other.sharp, there).share for one, other, there in placed]
    return float(np.median(shares)) if shares else 0.0


def loss_of_pair(
    source: SubmapFragment, target: SubmapFragment, transform: Transform, noise: float = 0.0
) -> float:
    """What a hypothesis within a stage loses, logarithm of the odds.

    Args:
        source: of the pair.
        target: of the pair.
        transform: `T_target_source`.
        noise: of the map's pairs, see `noise_of`.
    """
    share = contradiction(source.sharp, target.sharp, transform).share
    return min(_WEIGHT * max(share - _NONE - _NOISE * noise, 0.0), _MOST)


def loss_of_parts(
    one: Poses,
    other: Poses,
    transform: Transform,
    fragments: Fragments,
    noise: float = 0.0,
) -> float:
    """What a link of two parts loses by the worst contradictions of fragments near each other.

    Each fragment tells once: what one has of people contradicts all that others saw there.
    Scans that reach far have a measure of their own, see `conflict_loss`, and lose nothing here.

    Args:
        one: a part.
        other: another.
        transform: from the frame of the other to that of the one.
        fragments: all of them.
        noise: of the map's pairs, see `noise_of`.
    """
    none = _LARGEST_NONE + _LARGEST_NOISE * noise
    found: list[tuple[float, FragmentId, FragmentId]] = []
    for source, target in nearest_pairs(one, other, transform, fragments, _MOST_PAIRS):
        scans = fragments[source], fragments[target]
        if are_usual(*scans):
            pose = relative(transform @ other[source], one[target])
            share = contradiction(scans[0].sharp, scans[1].sharp, pose).share
            found.append((share - none, source, target))
    loss, told = 0.0, set[FragmentId]()
    for excess, *ends in sorted(found, reverse=True):
        if excess > 0 and told.isdisjoint(ends):
            loss += min(_WEIGHT * excess, _MOST_LARGEST)
            told.update(ends)
    return loss


def are_usual(one: SubmapFragment, other: SubmapFragment) -> bool:
    """Whether neither of two scans reaches far."""
    return evening(one.seen.shape[-1], other.seen.shape[-1]) == 1


def nearest_pairs(
    one: Poses, other: Poses, transform: Transform, fragments: Fragments, count: int
) -> list[tuple[FragmentId, FragmentId]]:
    """Fragments of the other part and of the one, of one stage, that are nearest each other.

    Args:
        one: a part.
        other: another.
        transform: from the frame of the other to that of the one.
        fragments: all of them.
        count: most pairs; fewer where others are too far apart to see much of each other.
    """
    ids, others = list(one), list(other)
    places = np.array([one[id_][:2, 3] for id_ in ids])
    moved = np.array([(transform @ other[id_])[:2, 3] for id_ in others])
    distances = np.linalg.norm(moved[:, None] - places, axis=2)
    stages = np.array([id_.stage for id_ in ids])
    distances[np.array([id_.stage for id_ in others])[:, None] != stages] = np.inf
    nearest = np.argsort(distances, axis=None, kind="stable")[:count]
    found = [np.unravel_index(each, distances.shape) for each in nearest]
    reach = [np.array([fragments[id_].reach for id_ in some]) for some in (others, ids)]
    near = distances < _FARTHEST * np.maximum(reach[0][:, None], reach[1])
    return [(others[i], ids[k]) for i, k in found if near[i, k]]
