"""Fragments as other scanners take them: out of level, noisier, or on a robot that they see.

A tilted tripod turns the sensor frame, and with it the true pose, so that ground truth stays true:
what the frame tells of gravity is wrong, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nss_ros.dataset.folder import DatasetFolder
from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.geometry import Transform, from_rotation, inverse, transform_points
from nss_ros.multiway.pose_graph import Edge, Node, NodeStatus, PoseGraph


@dataclass(frozen=True, slots=True)
class Perturbation:
    """What is done to each fragment by itself; the same fragment is always perturbed the same.

    Attributes:
        tilt: angle of the sensor's z axis to the vertical, about a level axis drawn at random,
            degrees.
        range_noise: standard deviation added to every range, metres.
        floating: points in empty air, between the sensor and what it saw, as a share of all.
        robot: the scanner stands on a robot, and sees its body.
        seed: of the axes, the noise and the points.
    """

    tilt: float = 0.0
    range_noise: float = 0.0
    floating: float = 0.0
    robot: bool = False
    seed: int = 0

    def __str__(self) -> str:
        parts = [f"tilt {self.tilt:g} deg"] if self.tilt else []
        parts += [f"noise {self.range_noise:g} m"] if self.range_noise else []
        parts += [f"{self.floating:.0%} floating"] if self.floating else []
        parts += ["robot"] if self.robot else []
        return ", ".join(parts)

    def fragment(self, fragment: Fragment) -> Fragment:
        """The fragment as it would have been scanned."""
        points = fragment.points
        if self.range_noise:
            points = _with_range_noise(points, self.range_noise, self._random(fragment.id, "noise"))
        if self.floating:
            points = _with_floating(points, self.floating, self._random(fragment.id, "floating"))
        if self.robot:
            points = np.concatenate((points, _body_of_robot()))
        if self.tilt:
            turn = self.T_tilted_level(fragment.id)
            points = transform_points(turn, points).astype(np.float32)
        return replace(fragment, points=points)

    def ground_truth(self, graph: PoseGraph) -> PoseGraph:
        """True poses and relative transforms of the perturbed fragments."""
        if not self.tilt:
            return graph
        return replace(
            graph,
            nodes=tuple(self._node(node) for node in graph.nodes),
            edges=tuple(self._edge(edge) for edge in graph.edges),
        )

    def T_tilted_level(self, id_: FragmentId) -> Transform:  # noqa: N802 - the field's name
        """From the frame of the levelled sensor to that of the tilted one."""
        heading = self._random(id_, "tilt").uniform(0, 2 * np.pi)
        axis = np.array((np.cos(heading), np.sin(heading), 0.0))
        return from_rotation(Rotation.from_rotvec(np.radians(self.tilt) * axis), np.zeros(3))

    def _node(self, node: Node) -> Node:
        if node.status is not NodeStatus.PLACED:
            return node
        pose = node.T_map_fragment @ inverse(self.T_tilted_level(node.id))
        return replace(node, T_map_fragment=pose)

    def _edge(self, edge: Edge) -> Edge:
        source, target = (self.T_tilted_level(id_) for id_ in (edge.pair.source, edge.pair.target))
        return replace(edge, T_target_source=target @ edge.T_target_source @ inverse(source))

    def _random(self, id_: FragmentId, purpose: str) -> np.random.Generator:
        words = f"{id_}|{purpose}".encode()
        return np.random.default_rng((self.seed, *words))


class PerturbedDataset(DatasetFolder):
    """A dataset whose fragments are read perturbed; its poses stay those of the files.

    Args:
        dataset: the folder.
        perturbation: of every fragment.
    """

    def __init__(self, dataset: DatasetFolder, perturbation: Perturbation) -> None:
        super().__init__(dataset.path)
        self.perturbation = perturbation

    def fragment(self, fragment: FragmentId) -> Fragment:
        """As `DatasetFolder.fragment`, perturbed."""
        return self.perturbation.fragment(super().fragment(fragment))


def _with_range_noise(points: Points, deviation: float, random: np.random.Generator) -> Points:
    """Points moved along their rays; the sensor is the origin."""
    ranges = np.linalg.norm(points, axis=1)
    noise: NDArray[np.float64] = random.normal(0.0, deviation, len(points))
    scale = np.maximum(1 + noise / np.maximum(ranges, 1e-6), 0.0)
    return np.asarray(points * scale[:, None], dtype=np.float32)


def _with_floating(points: Points, share: float, random: np.random.Generator) -> Points:
    """Points (n, 3), and others before so many of them."""
    chosen = points[random.permutation(len(points))[: round(share * len(points))]]
    nearer = (chosen * random.uniform(0.3, 1.0, (len(chosen), 1))).astype(np.float32)
    return np.concatenate((points, nearer))


def _body_of_robot() -> Points:
    """The upper half of an ellipsoid of 1.1 x 0.8 x 0.3 m beneath the sensor, (n, 3)."""
    outward = np.random.default_rng(0).normal(size=(4000, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    outward[:, 2] = np.abs(outward[:, 2])
    return (outward * (0.55, 0.4, 0.33) - (0.0, 0.0, 0.6)).astype(np.float32)
