"""Which pairs truly overlap, as far as a log tells.

Fragments overlap from an overlap ratio of theta = 0.1 (NSS paper). The truth of a pair is known

1. from its edge in a ground-truth graph, in the pair's direction or, for want of that, the other,
   if the edge gives an overlap ratio;
2. for fragments of different areas: they do not overlap;
3. for two fragments with a pose in one graph: from their point clouds, if the log has them;
4. for these without point clouds: they do not overlap if no edge links them and the log's
   metadata says that the graph lists every pair from an overlap ratio of at most theta, as
   `simulation.min_overlap` of a simulated bag does.

Of any other pair it is not known: a graph of a dataset may leave out overlapping pairs, so that
an edge is missing proves nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from nss_ros.bag import Log
from nss_ros.benchmark.classification import MIN_OVERLAP
from nss_ros.benchmark.metrics import Floats
from nss_ros.dataset.overlap import Cloud, pair_overlap
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import Transform, relative
from nss_ros.multiway.pose_graph import PoseGraph

COMPLETE_KEY = "simulation.min_overlap"
"""Metadata of a bag whose graph lists every pair from this overlap ratio."""

NAN = float("nan")


class OverlapClouds:
    """Overlap ratios of fragments by their point clouds, which are prepared once."""

    def __init__(self, fragments: Mapping[FragmentId, Fragment]) -> None:
        self._fragments = fragments
        self._clouds: dict[FragmentId, Cloud] = {}

    def has(self, pair: FragmentPair) -> bool:
        """Whether the clouds of both are there."""
        return pair.source in self._fragments and pair.target in self._fragments

    def ratio(self, pair: FragmentPair, T_target_source: Transform) -> float:
        """The overlap ratio of a pair of fragments that are there, aligned so."""
        source, target = self._cloud(pair.source), self._cloud(pair.target)
        return pair_overlap(source, target, T_target_source).overlap_ratio

    def _cloud(self, id_: FragmentId) -> Cloud:
        if id_ not in self._clouds:
            self._clouds[id_] = Cloud(self._fragments[id_].points)
        return self._clouds[id_]


class OverlapTruth:
    """The truth of each pair of a log; see the module.

    Args:
        log: with or without point clouds.
        graphs: its ground truth.
        clouds: of the log's fragments.
    """

    def __init__(self, log: Log, graphs: Sequence[PoseGraph], clouds: OverlapClouds) -> None:
        self._clouds = clouds
        self._poses = [
            {id_: node.T_map_fragment for id_, node in graph.poses().items()} for graph in graphs
        ]
        self._edges: dict[FragmentPair, float] = {}
        self._complete = _lists_all(log.metadata)
        for graph in graphs:
            for edge in graph.edges:
                ratio = self._edges.get(edge.pair, NAN)
                self._edges[edge.pair] = edge.overlap_ratio if np.isnan(ratio) else ratio

    def overlaps(self, pairs: Sequence[FragmentPair]) -> Floats:
        """1 for pairs that overlap, 0 for pairs that do not, NaN where it is not known, (n,)."""
        return np.array([self._overlaps(pair) for pair in pairs], dtype=np.float64)

    def _overlaps(self, pair: FragmentPair) -> float:
        for each in (pair, FragmentPair(pair.target, pair.source)):
            ratio = self._edges.get(each, NAN)
            if not np.isnan(ratio):
                return float(ratio >= MIN_OVERLAP)
        if pair.source.area != pair.target.area:
            return 0.0
        poses = next((p for p in self._poses if pair.source in p and pair.target in p), None)
        if poses is None:
            return NAN
        if self._clouds.has(pair):
            truth = relative(poses[pair.source], poses[pair.target])
            return float(self._clouds.ratio(pair, truth) >= MIN_OVERLAP)
        linked = pair in self._edges or FragmentPair(pair.target, pair.source) in self._edges
        return 0.0 if self._complete and not linked else NAN


def _lists_all(metadata: Mapping[str, str]) -> bool:
    try:
        return float(metadata.get(COMPLETE_KEY, "nan")) <= MIN_OVERLAP
    except ValueError:
        return False
