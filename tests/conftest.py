"""What several tests need."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, inverse, relative, transform_points
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph

settings.register_profile("default", deadline=None, max_examples=50, derandomize=True)
settings.load_profile("default")

# A shell's background job ignores Ctrl-C, and the processes of the tests would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Where these are set, pytest looks for the smallest difference between what a test compares, which
# takes more than an hour for two clouds.
for _variable in ("CI", "BUILD_NUMBER"):
    os.environ.pop(_variable, None)

_SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real scans and official expectations; tests that need it skip without it."""
    if not _SHARED.is_dir():
        pytest.skip("the shared test data are not here")
    return _SHARED


class Room:
    """A small furnished room, scanned from known poses: fragments with their ground truth."""

    def __init__(self, spots_per_stage: int, stages: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        surface = _room_points(rng)
        self.fragments = []
        nodes = []
        for stage in range(1, stages + 1):
            for spot in range(spots_per_stage):
                position = (*rng.uniform((1.5, 1.5), (4.5, 3.5)), 1.6)
                pose = from_yaw(rng.uniform(-np.pi, np.pi), position)
                near = surface[np.linalg.norm(surface - position, axis=1) < 4.5]
                points = transform_points(inverse(pose), near + rng.normal(0, 0.004, near.shape))
                id_ = FragmentId("1", stage, spot)
                self.fragments.append(Fragment(id_, points.astype(np.float32), True))
                nodes.append(Node(id_, pose, NodeStatus.PLACED))
        self.pairs = [
            FragmentPair(source.id, target.id)
            for i, target in enumerate(self.fragments)
            for source in self.fragments[i + 1 :]
        ]
        poses = {node.id: node.T_map_fragment for node in nodes}
        self.ground_truth = PoseGraph(
            tuple(nodes),
            tuple(
                Edge(
                    pair,
                    relative(poses[pair.source], poses[pair.target]),
                    EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE,
                )
                for pair in self.pairs
            ),
            name="room",
        )


@pytest.fixture(scope="session")
def room() -> Room:
    """Two stages, three spots each, all pairs overlapping."""
    return Room(spots_per_stage=3, stages=2)


def _room_points(rng: np.random.Generator) -> np.ndarray:
    """Surface points of a 6 x 5 x 2.8 m room with boxes that make it unambiguous, (n, 3)."""
    boxes = [
        ((0, 0, 0), (6, 5, 2.8)),
        ((0.3, 0.2, 0), (1.1, 2.0, 0.8)),
        ((4.6, 0.4, 0), (5.6, 1.2, 1.9)),
        ((2.4, 4.2, 0), (3.9, 4.9, 1.2)),
        ((5.2, 3.1, 0), (5.8, 4.6, 0.5)),
        ((1.4, 3.6, 1.1), (2.0, 3.9, 2.8)),
    ]
    return np.concatenate([_box_points(rng, np.array(a), np.array(b)) for a, b in boxes])


def _box_points(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    faces = []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        count = int(np.prod((high - low)[others]) * 150)
        for value in (low[axis], high[axis]):
            points = rng.uniform(low, high, (count, 3))
            points[:, axis] = value
            faces.append(points)
    return np.concatenate(faces)
