"""From measurements to what the network takes, and the poses that it starts from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId
from nss_ros.geometry import inverse
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.posegraphnet.network import GraphTensors
from nss_ros.multiway.posegraphnet.rigid import Rigid
from nss_ros.multiway.spanning_tree import Closeness, Poses, components, spanning_tree_poses
from nss_ros.multiway.triangles import triangle_support


def graph_tensors(
    members: Sequence[FragmentId], measurements: Sequence[Measurement]
) -> GraphTensors:
    """Measurements between the members as one graph, float64, metres."""
    index = {id_: i for i, id_ in enumerate(members)}
    ends = np.array([(index[m.pair.source], index[m.pair.target]) for m in measurements])
    source, target = torch.from_numpy(ends.reshape(-1, 2).T.copy())
    matrices = np.array([m.T_target_source for m in measurements]).reshape(-1, 4, 4)
    return GraphTensors(
        source,
        target,
        Rigid.of(torch.from_numpy(matrices)),
        torch.zeros(len(members), dtype=torch.int64),
    )


def tree_poses(
    fragments: Sequence[FragmentId], measurements: Sequence[Measurement], close: Closeness
) -> Poses:
    """Poses by a spanning tree of each component, in the frame of its first fragment.

    The tree is grown from the measurements that most triangles support.
    """
    support = triangle_support(measurements, close.translation, close.rotation)
    ranks = np.array(
        [(m.manual, count, m.confidence) for m, count in zip(measurements, support, strict=True)],
        dtype=np.float64,
    ).reshape(-1, 3)
    poses: Poses = {}
    for members in components(fragments, measurements):
        inside = [i for i, m in enumerate(measurements) if m.pair.source in set(members)]
        poses |= _grown(members, [measurements[i] for i in inside], ranks[inside], close)
    return poses


def _grown(
    members: list[FragmentId],
    measurements: list[Measurement],
    ranks: NDArray[np.float64],
    close: Closeness,
) -> Poses:
    if not measurements:
        return {members[0]: np.eye(4)}
    return spanning_tree_poses(members, measurements, ranks, close)


def pose_tensors(poses: Poses, members: Sequence[FragmentId]) -> Rigid:
    """`T_fragment_map` (n) of poses `T_map_fragment`."""
    matrices = np.array([inverse(poses[id_]) for id_ in members]).reshape(-1, 4, 4)
    return Rigid.of(torch.from_numpy(matrices))
