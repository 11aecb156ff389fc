"""The bundled bag: a simulated building of three stages with its true poses."""

from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import read_log
from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative, rotation_angle
from nss_ros.multiway.pose_graph import Alternative, Measurement
from nss_ros.multiway.solver import prepared_by
from nss_ros.multiway.submap import Submap

_BAG = Path(__file__).parents[2] / "bags" / "three_stages"
INFORMATION = np.diag([1 / 0.02**2] * 3 + [1 / 0.01**2] * 3)


class Building:
    """Its fragments, where they are, and what submaps need of them."""

    def __init__(self, log):
        (graph,) = log.ground_truth
        self.fragments = log.fragments
        self.poses = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
        self.pairs = log.pairs
        self.prepared = prepared_by(MultiwayConfig(), log.fragments.values())

    def spots(self, stage, *spots):
        return [FragmentId("1", stage, spot) for spot in spots]

    def part(self, ids):
        """True poses in the frame of the first fragment."""
        return {id_: relative(self.poses[id_], self.poses[ids[0]]) for id_ in ids}

    def submap(self, ids):
        return Submap.of(self.part(ids), self.prepared)

    def truth(self, pair):
        return relative(self.poses[pair.source], self.poses[pair.target])

    def error(self, T_target_source, source, target):
        """Metres and degrees between a transform of two fragments' frames and the true one."""
        error = relative(T_target_source, self.truth(FragmentPair(source, target)))
        return np.linalg.norm(error[:3, 3]), np.degrees(rotation_angle(error))

    def worst(self, poses):
        """Largest error (m, deg) of poses in one frame."""
        first, *others = poses
        found = [self.error(relative(poses[id_], poses[first]), id_, first) for id_ in others]
        return tuple(np.max([(0.0, 0.0), *found], axis=0))

    def asked(self, ids):
        """The pairs of the bag between these fragments."""
        return [pair for pair in self.pairs if pair.source in ids and pair.target in ids]

    def right(self, pair, confidence=0.9, **fields):
        """A measurement of a pair that is right."""
        truth = self.truth(pair)
        return Measurement(pair, truth, INFORMATION, confidence, 1000, level=True, **fields)

    def wrong(self, pair, seed, confidence=0.6, right=0.0):
        """A measurement that is wrong; an alternative is right, if that has a probability."""
        random = np.random.default_rng(seed)
        elsewhere = from_yaw(random.uniform(0.5, 5.5), (*random.uniform(-4, 4, 2), 0.0))
        found = self.truth(pair) @ elsewhere
        others = (Alternative(self.truth(pair), INFORMATION, right),) if right else ()
        return Measurement(
            pair, found, INFORMATION, confidence, 1000, level=True, alternatives=others
        )


@pytest.fixture(scope="session")
def building():
    return Building(read_log(_BAG))
