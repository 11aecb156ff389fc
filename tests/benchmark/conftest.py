"""Runs over a small room, without running anything."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import Log
from nss_ros.geometry import exponential
from nss_ros.multiway.pose_graph import PoseGraph
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
