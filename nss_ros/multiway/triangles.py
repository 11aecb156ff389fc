"""Support of relative transforms by the triangles that they close.

Two wrong transforms seldom agree with a third: an edge whose triangles close is most likely
right. METHODS: initial poses from a spanning tree grown by this support decide whether robust
optimisation succeeds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nss_ros.fragment import FragmentId
from nss_ros.geometry import inverse
from nss_ros.multiway.pose_graph import Measurement


def triangle_support(
    measurements: Sequence[Measurement], translation: float, rotation: float
) -> NDArray[np.int64]:
    """How many triangles with two other measurements each measurement closes, (n,).

    Args:
        measurements: any number; several of one pair are different edges of a multigraph.
        translation: a triangle closes when its loop moves the origin less than this, metres ...
        rotation: ... and turns by less than this, radians.
    """
    support = np.zeros(len(measurements), dtype=np.int64)
    links = _links(measurements)
    for i, edge in enumerate(measurements):
        source, target = edge.pair.source, edge.pair.target
        first, second = _paths(links, source, target)
        if not len(first[0]):
            continue
        # target <- third <- source, against the edge itself.
        around = np.linalg.inv(edge.T_target_source) @ second[1] @ first[1]
        near = np.linalg.norm(around[:, :3, 3], axis=1) < translation
        turned = Rotation.from_matrix(around[:, :3, :3]).magnitude() < rotation
        support[i] = np.count_nonzero(near & turned)
    return support


_Links = dict[FragmentId, dict[FragmentId, list[NDArray[np.float64]]]]


def _links(measurements: Sequence[Measurement]) -> _Links:
    """`links[a][b]`: the transforms from a to b, measured either way round."""
    links: _Links = {}
    for edge in measurements:
        source, target = edge.pair.source, edge.pair.target
        links.setdefault(source, {}).setdefault(target, []).append(edge.T_target_source)
        links.setdefault(target, {}).setdefault(source, []).append(inverse(edge.T_target_source))
    return links


_Leg = tuple[list[FragmentId], NDArray[np.float64]]


def _paths(links: _Links, source: FragmentId, target: FragmentId) -> tuple[_Leg, _Leg]:
    """All ways from source to target over one other fragment, as two stacks of transforms."""
    thirds: list[FragmentId] = []
    first: list[NDArray[np.float64]] = []
    second: list[NDArray[np.float64]] = []
    for third in links[source].keys() & links[target].keys():
        for T_third_source in links[source][third]:
            for T_target_third in links[third][target]:
                thirds.append(third)
                first.append(T_third_source)
                second.append(T_target_third)
    stack = (np.array(first).reshape(-1, 4, 4), np.array(second).reshape(-1, 4, 4))
    return (thirds, stack[0]), (thirds, stack[1])
