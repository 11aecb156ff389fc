"""The clouds of a growing map: what is in them, and which of them changed."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.geometry import Transform, transform_points
from nss_ros.multiway.multi_stage_map import merged_points
from nss_ros.multiway.pose_graph import PoseGraph

Layer = tuple[int, int]
"""A component and a stage."""
_Placed = dict[FragmentId, tuple[Fragment, Transform]]


class MapClouds:
    """The points of each stage of each component; made anew only when they changed."""

    def __init__(self) -> None:
        self._voxel_size = 0.0
        self._placed: dict[Layer, _Placed] = {}
        self._points: dict[Layer, Points] = {}

    def update(
        self,
        fragments: Mapping[FragmentId, Fragment],
        graph: PoseGraph,
        voxel_size: float,
        tolerance: float,
    ) -> set[Layer]:
        """Follow a graph; the layers that changed, or are gone.

        Args:
            fragments: by id.
            graph: poses.
            voxel_size: metres; stages are voxelised apart, so that change stays visible.
            tolerance: metres; a layer in which nothing moved farther counts as the same.
        """
        placed = _layers(fragments, graph)
        changed = {
            layer
            for layer in self._placed.keys() | placed.keys()
            if voxel_size != self._voxel_size
            or _differ(self._placed.get(layer, {}), placed.get(layer, {}), tolerance)
        }
        self._voxel_size = voxel_size
        for layer in changed:
            self._placed.pop(layer, None)
            self._points.pop(layer, None)
            if layer in placed:
                self._placed[layer] = placed[layer]
                self._points[layer] = merged_points(placed[layer].values(), voxel_size)
        return changed

    def layers(self) -> set[Layer]:
        """All that there are."""
        return set(self._points)

    def stage(self, component: int, stage: int) -> tuple[Points, NDArray[np.float32]]:
        """Points (n, 3) float32 of one stage in the component's frame, and their stages (n,)."""
        points = self._points.get((component, stage), np.zeros((0, 3), np.float32))
        return points, np.full(len(points), stage, np.float32)

    def component(self, number: int) -> tuple[Points, NDArray[np.float32]]:
        """Points (n, 3) float32 of all stages in the component's frame, and their stages (n,)."""
        layers = sorted(layer for layer in self._points if layer[0] == number)
        clouds = [self.stage(*layer) for layer in layers] or [self.stage(number, 0)]
        points, stages = zip(*clouds, strict=True)
        return np.concatenate(points), np.concatenate(stages)


def _layers(fragments: Mapping[FragmentId, Fragment], graph: PoseGraph) -> dict[Layer, _Placed]:
    layers: dict[Layer, _Placed] = {}
    for id_, node in graph.poses().items():
        if id_ in fragments and len(fragments[id_].points):
            layer = layers.setdefault((node.component, id_.stage), {})
            layer[id_] = fragments[id_], node.T_map_fragment
    return layers


def _differ(one: _Placed, other: _Placed, tolerance: float) -> bool:
    if one.keys() != other.keys():
        return True
    for id_, (fragment, before) in one.items():
        same, now = other[id_]
        if same is not fragment or _moved(fragment.points, before, now) > tolerance:
            return True
    return False


def _moved(points: Points, before: Transform, now: Transform) -> float:
    """No point moved farther than this, metres."""
    limits = points.min(axis=0), points.max(axis=0)
    corners = np.array(list(product(*np.transpose(limits).tolist())))
    steps = transform_points(now, corners) - transform_points(before, corners)
    return float(np.linalg.norm(steps, axis=1).max())
