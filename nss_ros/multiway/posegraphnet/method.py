"""The synchronizer `posegraphnet`: a graph network moves all poses, step by step."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId
from nss_ros.geometry import as_transform
from nss_ros.multiway.judged_edge import contradiction, judged_edges, judged_graph
from nss_ros.multiway.pose_graph import Measurement, PoseGraph
from nss_ros.multiway.posegraphnet.network import SynchronizationNetwork
from nss_ros.multiway.posegraphnet.rigid import Rigid
from nss_ros.multiway.posegraphnet.start import graph_tensors, pose_tensors, tree_poses
from nss_ros.multiway.posegraphnet.weights import Usage, load_weights
from nss_ros.multiway.spanning_tree import Closeness, Poses, components


class PoseGraphNet:
    """Learned synchronization of each connected component.

    It takes one relative transform of each pair and nothing else of it: neither confidence nor
    covariance has a place in the network. Where an edge is `manual` it is never rejected, but it
    counts as the others do.

    Args:
        config: settings.

    Raises:
        MethodError: the weights cannot be read.
    """

    name = "posegraphnet"

    def __init__(self, config: MultiwayConfig) -> None:
        self._config = config
        # The sums of one thread are always the same.
        torch.set_num_threads(1)
        self._network, self._usage = load_weights(config.posegraphnet_weights)

    @property
    def close(self) -> Closeness:
        """When a loop of edges closes, and when an edge agrees with the poses."""
        return Closeness(self._config.loop_translation, math.radians(self._config.loop_rotation))

    def synchronize(
        self, fragments: Sequence[FragmentId], measurements: Sequence[Measurement]
    ) -> PoseGraph:
        """Poses of all fragments; see `Synchronizer.synchronize`."""
        ids = sorted(set(fragments))
        edges = judged_edges(ids, measurements, self._config)
        poses = self.poses(ids, [edge.measurement for edge in edges if edge.accepted])
        for edge in edges:
            m = edge.measurement
            if edge.accepted and not m.manual and (reason := contradiction(m, poses, self.close)):
                edge.reject(reason)
        return judged_graph(ids, edges, poses, self.name)

    def poses(self, ids: Sequence[FragmentId], measurements: Sequence[Measurement]) -> Poses:
        """`T_map_fragment` of all fragments, each component in the frame of its first one.

        Args:
            ids: all fragments, in canonical order.
            measurements: between them, in canonical order.
        """
        start: Poses = {}
        if self._usage.start == "tree":
            start = tree_poses(ids, measurements, self.close)
        poses: Poses = {}
        for members in components(ids, measurements):
            inside = set(members)
            own = [m for m in measurements if m.pair.source in inside]
            poses |= moved(self._network, self._usage, members, own, start)
        return poses


def moved(
    network: SynchronizationNetwork,
    usage: Usage,
    members: Sequence[FragmentId],
    measurements: Sequence[Measurement],
    start: Poses,
) -> Poses:
    """Poses of one component after all steps of the network, in the frame of its first fragment.

    Args:
        network: float64.
        usage: how it is run.
        members: of the component.
        measurements: between them.
        start: `T_map_fragment` of the members at first; empty: all the same.
    """
    graph = graph_tensors(members, measurements)
    if start:
        poses = pose_tensors(start, members)
    else:
        poses = Rigid.identity(len(members), graph.measured.translation)
    if measurements:
        with torch.no_grad():
            for _ in range(usage.rounds):
                poses = network(graph, poses, usage.steps)[-1].poses
    matrices = (poses.take(torch.tensor([0])).matrices() @ poses.inverse().matrices()).numpy()
    return {id_: as_transform(each) for id_, each in zip(members, matrices, strict=True)}
