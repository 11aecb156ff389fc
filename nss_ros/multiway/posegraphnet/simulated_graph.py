"""Graphs of relative transforms with known poses, drawn at random, as those of building sites.

Level tripods on a floor, in several stages; pairs of near ones; of each pair one relative
transform, which is right but for some noise, or wrong at random, or an alias: right for a building
that is shifted by a bay, or turned by a quarter or a half. Aliases are shared by many pairs
between two groups of fragments, and so agree with each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, from_rotation, from_yaw, inverse, relative
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.spanning_tree import Poses

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class GraphSettings:
    """From which ranges the properties of a graph are drawn; (low, high) each.

    Attributes:
        fragments: how many.
        stages: at most so many; a stage has four fragments at least.
        degree: pairs per fragment, on average.
        right_within: share of right transforms among pairs of one stage.
        right_across: share of right transforms among pairs of different stages.
        aliased: share of aliases among the wrong ones.
        noise_translation: how far measurements are off, root mean square, metres ...
        noise_rotation: ... and turned about the vertical, degrees; half of it about the others.
        tilted: probability that the random ones of a graph are not level.
    """

    fragments: Range = (20, 60)
    stages: Range = (2, 6)
    degree: Range = (4, 15)
    right_within: Range = (0.5, 0.9)
    right_across: Range = (0.1, 0.8)
    aliased: Range = (0.0, 0.8)
    noise_translation: Range = (0.02, 0.1)
    noise_rotation: Range = (0.5, 2.0)
    tilted: float = 0.2


@dataclass(frozen=True, slots=True)
class SimulatedGraph:
    """A graph and its truth.

    Attributes:
        poses: true `T_map_fragment`, in canonical order.
        measurements: one per pair.
        right: (m,) which of them are right.
    """

    poses: Poses
    measurements: tuple[Measurement, ...]
    right: NDArray[np.bool_]

    @property
    def fragments(self) -> list[FragmentId]:
        """Ids in canonical order."""
        return list(self.poses)


def simulated_graph(rng: np.random.Generator, settings: GraphSettings) -> SimulatedGraph:
    """A graph drawn at random."""
    poses = _tripods(rng, settings)
    pairs = _pairs(rng, poses, rng.uniform(*settings.degree))
    right = _right(rng, pairs, settings)
    aliases = _Aliases(rng, poses)
    aliased = rng.uniform(*settings.aliased)
    tilted = bool(rng.random() < settings.tilted)
    deviation = rng.uniform(*settings.noise_translation)
    turning = np.radians(rng.uniform(*settings.noise_rotation))
    spread = np.array([deviation / np.sqrt(3)] * 3 + [turning / 2] * 2 + [turning])
    measurements = []
    for pair, is_right in zip(pairs, right, strict=True):
        found = relative(poses[pair.source], poses[pair.target])
        if not is_right and rng.random() < aliased:
            found = aliases.of(pair)
        elif not is_right:
            found = _anywhere(rng, tilted)
        confidence = rng.uniform(0.2, 1.0) if is_right else rng.uniform(0.0, 0.9)
        measurements.append(
            Measurement(
                pair,
                _noisy(found, rng.normal(0, spread)),
                np.diag(spread**-2.0),
                confidence=float(confidence),
                inliers=1000,
            )
        )
    return SimulatedGraph(poses, tuple(measurements), right)


def _tripods(rng: np.random.Generator, settings: GraphSettings) -> Poses:
    """Level poses, every stage on the same floor, its spots apart from each other."""
    count = int(rng.integers(int(settings.fragments[0]), int(settings.fragments[1]) + 1))
    most = min(int(settings.stages[1]), count // 4)
    stages = int(rng.integers(min(int(settings.stages[0]), most), most + 1)) if most else 1
    sizes = [len(part) for part in np.array_split(np.arange(count), stages)]
    area = sizes[0] * rng.uniform(5.0, 12.0)
    length = np.sqrt(area * rng.uniform(1.0, 6.0))
    poses = {}
    for stage, size in enumerate(sizes, 1):
        level = rng.normal(0, 0.05)
        for spot, (x, y) in enumerate(_spots(rng, size, length, area / length), 1):
            tilt = Rotation.from_rotvec([*np.radians(rng.normal(0, 0.5, 2)), 0.0])
            turned = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * tilt
            place = (x, y, level + rng.normal(0, 0.05))
            poses[FragmentId("1", stage, spot)] = from_rotation(turned, place)
    return poses


def _spots(
    rng: np.random.Generator, count: int, length: float, width: float
) -> NDArray[np.float64]:
    """Places (count, 2), each the loneliest of four that are drawn."""
    spots = [rng.uniform((0, 0), (length, width))]
    while len(spots) < count:
        drawn = rng.uniform((0, 0), (length, width), (4, 2))
        lonely, _ = cKDTree(spots).query(drawn)
        spots.append(drawn[np.argmax(lonely)])
    return np.array(spots)


def _pairs(rng: np.random.Generator, poses: Poses, degree: float) -> list[FragmentPair]:
    """Pairs of near fragments, some of them left out."""
    ids = list(poses)
    places = np.array([poses[id_][:2, 3] for id_ in ids])
    wanted = round(len(ids) * degree / 2)
    radius = rng.uniform(4.5, 7.0)
    near = cKDTree(places).query_pairs(radius, output_type="ndarray")
    far = np.linalg.norm(places[near[:, 0]] - places[near[:, 1]], axis=1)
    # The nearer, the likelier to be asked for.
    drawn = near[np.argsort(far / radius + rng.uniform(0, 1, len(near)))[:wanted]]
    turned = rng.random(len(drawn)) < 0.5
    drawn[turned] = drawn[turned, ::-1]
    return sorted(FragmentPair(ids[one], ids[other]) for one, other in drawn)


def _right(
    rng: np.random.Generator, pairs: list[FragmentPair], settings: GraphSettings
) -> NDArray[np.bool_]:
    within, across = rng.uniform(*settings.right_within), rng.uniform(*settings.right_across)
    rates = np.array([within if pair.same_stage else across for pair in pairs])
    return rng.random(len(pairs)) < rates


class _Aliases:
    """Where the fragments seem to be to others, wrongly but consistently."""

    def __init__(self, rng: np.random.Generator, poses: Poses) -> None:
        self._poses = poses
        self._groups = _groups(rng, poses)
        stages = sorted({id_.stage for id_ in poses})
        places = np.array([pose[:3, 3] for pose in poses.values()])
        self._moved: dict[tuple[int, int, int], Transform] = {}
        for key in product(stages, stages, sorted(set(self._groups.values()))):
            centre = np.array([*rng.uniform(places.min(0), places.max(0))[:2], 0.0])
            self._moved[key] = _alias(rng, centre)

    def of(self, pair: FragmentPair) -> Transform:
        """The wrong `T_target_source` of a pair."""
        key = (pair.source.stage, pair.target.stage)
        group = self._groups[min(pair.source, pair.target)]
        low, high = sorted(key)
        moved = self._moved[low, high, group]
        if key[0] > key[1]:
            moved = inverse(moved)
        return relative(moved @ self._poses[pair.source], self._poses[pair.target])


def _groups(rng: np.random.Generator, poses: Poses) -> dict[FragmentId, int]:
    """Halves of the floor, or all of it."""
    along = np.array([pose[0, 3] for pose in poses.values()])
    cut = rng.uniform(along.min(), along.max()) if rng.random() < 0.5 else np.inf
    return dict(zip(poses, (along > cut).astype(int).tolist(), strict=True))


def _alias(rng: np.random.Generator, centre: NDArray[np.float64]) -> Transform:
    """A shift by a bay along one wall, or a turn about a centre."""
    if rng.random() < 0.6:
        shift = np.zeros(3)
        shift[rng.integers(2)] = rng.choice((-1.0, 1.0)) * rng.uniform(3.0, 6.0)
        return from_yaw(0.0, shift)
    yaw = float(rng.choice((np.pi, np.pi / 2, -np.pi / 2)))
    there = from_yaw(0.0, centre)
    return there @ from_yaw(yaw, np.zeros(3)) @ inverse(there)


def _noisy(transform: Transform, noise: NDArray[np.float64]) -> Transform:
    """A transform, shifted and turned in place."""
    turned = Rotation.from_rotvec(noise[3:]) * Rotation.from_matrix(transform[:3, :3])
    return from_rotation(turned, transform[:3, 3] + noise[:3])


def _anywhere(rng: np.random.Generator, tilted: bool) -> Transform:
    """A transform of two fragments that could overlap."""
    distance, bearing = 6.0 * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    place = (distance * np.cos(bearing), distance * np.sin(bearing), rng.normal(0, 0.15))
    if tilted:
        return from_rotation(Rotation.random(rng=rng), place)
    return from_yaw(rng.uniform(-np.pi, np.pi), place)
