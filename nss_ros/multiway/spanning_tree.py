"""Initial poses by walking a spanning tree of the best measurements."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, inverse
from nss_ros.multiway.pose_graph import Measurement

Poses = dict[FragmentId, Transform]


def components(
    fragments: Sequence[FragmentId], measurements: Sequence[Measurement]
) -> list[list[FragmentId]]:
    """Connected components, largest first, ties and members in canonical order."""
    parent = {id_: id_ for id_ in fragments}

    def root(id_: FragmentId) -> FragmentId:
        while parent[id_] != id_:
            parent[id_] = parent[parent[id_]]
            id_ = parent[id_]
        return id_

    for edge in measurements:
        one, other = sorted((root(edge.pair.source), root(edge.pair.target)))
        parent[other] = one
    groups: dict[FragmentId, list[FragmentId]] = {}
    for id_ in sorted(fragments):
        groups.setdefault(root(id_), []).append(id_)
    return sorted(groups.values(), key=lambda group: (-len(group), group[0]))


def spanning_tree_poses(
    members: Sequence[FragmentId],
    measurements: Sequence[Measurement],
    ranks: NDArray[np.float64],
) -> Poses:
    """Poses `T_anchor_fragment` of one component, the first member being the anchor.

    The tree is grown from the best measurement (Prim): each step adds the best measurement that
    leads to a new fragment. Growing it in one piece keeps wrong measurements at its leaves.

    Args:
        members: of the component.
        measurements: that link them, all within the component.
        ranks: (n, k) per measurement; larger is better, the first column counts first.
    """
    if not measurements:
        return {id_: np.eye(4) for id_ in members}
    order = sorted(range(len(measurements)), key=lambda i: (*(-ranks[i]), measurements[i].pair))
    place = {edge: position for position, edge in enumerate(order)}
    touching: dict[FragmentId, list[int]] = {id_: [] for id_ in members}
    for i, edge in enumerate(measurements):
        touching[edge.pair.source].append(place[i])
        touching[edge.pair.target].append(place[i])
    first = measurements[order[0]].pair.target
    poses: Poses = {first: np.eye(4)}
    frontier = sorted(touching[first])
    while len(poses) < len(members):
        best = measurements[order[heappop(frontier)]]
        source, target = best.pair.source, best.pair.target
        if source in poses and target in poses:
            continue
        if target in poses:
            new, poses[source] = source, poses[target] @ best.T_target_source
        else:
            new, poses[target] = target, poses[source] @ inverse(best.T_target_source)
        for position in touching[new]:
            heappush(frontier, position)
    return anchored(poses, members[0])


def anchored(poses: Poses, anchor: FragmentId) -> Poses:
    """The same poses in the frame of one fragment."""
    to_anchor = inverse(poses[anchor])
    return {id_: to_anchor @ pose for id_, pose in poses.items()}
