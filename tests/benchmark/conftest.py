"""Runs over a small room, without running anything."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import Log
from nss_ros.geometry import exponential
from nss_ros.multiway.pose_graph import EdgeStatus, PoseGraph
from nss_ros.registration.relative_transform import RelativeTransform


@pytest.fixture
def make_run(room):
    """Makes the log of a run: the truth moved by noise, the pairs named in `wrong` far off."""

    def make(name="run", noise=0.01, wrong=(), seed=0, **changes):
        rng = np.random.default_rng(seed)

        def moved(transform):
            return transform @ exponential(rng.normal(scale=noise, size=6))

        edges = tuple(
            replace(edge, overlap_ratio=(i + 0.5) / 15, temporal_change=i / 15)
            for i, edge in enumerate(room.ground_truth.edges)
        )
        truth = replace(room.ground_truth, edges=edges)
        answers = {}
        for i, edge in enumerate(edges):
            T = exponential((2, 0, 0, 0, 0, 1)) if i in wrong else np.eye(4)
            answers[edge.pair] = RelativeTransform(
                edge.pair,
                "test",
                T @ moved(edge.T_target_source),
                overlap_probability=(i + 0.5) / 15,
                confidence=0.2 if i in wrong else 0.9,
            )
        nodes = tuple(replace(n, T_map_fragment=moved(n.T_map_fragment)) for n in truth.nodes)
        log = Log(
            path=Path(name),
            fragments={f.id: replace(f, points=f.points[::40]) for f in room.fragments},
            pairs=tuple(room.pairs),
            relative_transforms=answers,
            ground_truth=(truth,),
            pose_graph=PoseGraph(nodes, edges, "map", "truth"),
        )
        return replace(log, **changes)

    return make


@pytest.fixture
def cut():
    """Cuts the map of a log into components."""

    def cut_map(log, *ends):
        """The log with a map in components of nodes up to each end, each in a frame of its own."""
        nodes = []
        for component, (begin, end) in enumerate(pairwise((0, *ends))):
            frame = exponential([50.0 * component, 0, 0, 0, 0, 1.0 * component])
            nodes += [
                replace(n, T_map_fragment=frame @ n.T_map_fragment, component=component)
                for n in log.pose_graph.nodes[begin:end]
            ]
        of = {node.id: node.component for node in nodes}
        edges = tuple(
            edge
            if of[edge.pair.source] == of[edge.pair.target]
            else replace(edge, status=EdgeStatus.REJECTED)
            for edge in log.pose_graph.edges
        )
        graph = replace(log.pose_graph, nodes=tuple(nodes), edges=edges)
        return replace(log, pose_graph=graph)

    return cut_map
