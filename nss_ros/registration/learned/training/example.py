"""Pairs to learn from: the training pairs of a dataset's split, turned at random.

Only the sets "train" and "val" of a split are read here, never "test".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nss_ros.config import TrainingConfig
from nss_ros.dataset.annotate import pair_sets
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.splits import Split
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair, Points, clean_points
from nss_ros.geometry import Transform, from_rotation, inverse, relative, transform_points

# Tripods are levelled to a degree or two.
_MOST_TILT = np.radians(3.0)


@dataclass(frozen=True, slots=True)
class Example:
    """Two fragments with their true relative transform.

    Attributes:
        source: (n, 3) float32, finite, metres.
        target: (m, 3) float32, finite, metres.
        T_target_source: (4, 4) float64.
    """

    source: Points
    target: Points
    T_target_source: Transform


class ExampleSource:
    """Draws examples from pairs of a dataset.

    Args:
        dataset: complete.
        pairs: to draw from, not empty.
        config: how fragments are turned.
        seed: two numbers; the same ones give the same examples.
    """

    def __init__(
        self,
        dataset: DatasetFolder,
        pairs: Sequence[FragmentPair],
        config: TrainingConfig,
        seed: tuple[int, int],
    ) -> None:
        self._dataset = dataset
        self._poses = dataset.poses()
        self._pairs = pairs
        self._config = config
        self._seed = seed

    def drawn(self, number: int, attempt: int) -> tuple[Example, np.random.Generator]:
        """The example of a number and attempt, of any pair, and what else is random about it.

        Raises:
            FormatError: a fragment cannot be read.
        """
        random = np.random.default_rng((*self._seed, number, attempt))
        return self._example(self._pairs[int(random.integers(len(self._pairs)))], random), random

    def at(self, place: int) -> tuple[Example, np.random.Generator]:
        """The pair at a place of the list, always turned in the same way.

        Raises:
            FormatError: a fragment cannot be read.
        """
        random = np.random.default_rng((*self._seed, place))
        return self._example(self._pairs[place], random), random

    def _example(self, pair: FragmentPair, random: np.random.Generator) -> Example:
        source, target = (
            clean_points(self._dataset.fragment(each).points) for each in (pair.source, pair.target)
        )
        truth = relative(self._poses[pair.source], self._poses[pair.target])
        return augmented(Example(source, target, truth), self._config, random)


def training_pairs(
    dataset: DatasetFolder, split: Split, same_stage_only: bool, min_overlap: float
) -> tuple[list[FragmentPair], list[FragmentPair]]:
    """The pairs to learn from, and those to validate with, of a split.

    Args:
        dataset: with `pairs.csv`.
        split: whose sets "train" and "val"; its test pairs are left alone.
        same_stage_only: whether pairs of different stages are left out, as in the paper's table
            of what methods learn from one stage at a time.
        min_overlap: least overlap ratio.

    Raises:
        InputError: there are no pairs, or none to learn from.
        FormatError: they cannot be read.
    """
    sets = pair_sets(dataset, split)
    found = []
    for name in ("train", "val"):
        table = sets[name]
        kept = table.overlap_ratio >= min_overlap
        if same_stage_only:
            kept &= table.same_stage
        found.append(list(table.take(kept).pairs))
    if not found[0]:
        raise InputError(
            f"The split {split} of {dataset.path} has no training pairs with an overlap ratio of "
            f"at least {min_overlap:g}: choose another --split, or lower training.min_overlap."
        )
    return found[0], found[1]


def augmented(example: Example, config: TrainingConfig, random: np.random.Generator) -> Example:
    """The example with both clouds turned about their origins and noise on their points."""
    turns = [from_rotation(_rotation(config.rotations, random), np.zeros(3)) for _ in range(2)]
    source, target = (
        (transform_points(turn, points) + random.normal(0, config.noise, points.shape)).astype(
            np.float32
        )
        for turn, points in zip(turns, (example.source, example.target), strict=True)
    )
    truth = turns[1] @ example.T_target_source @ inverse(turns[0])
    return Example(source, target, truth)


def _rotation(kind: str, random: np.random.Generator) -> Rotation:
    if kind == "any":
        return Rotation.random(random_state=random)
    yaw = Rotation.from_euler("z", random.uniform(0, 2 * np.pi))
    axis = random.uniform(0, 2 * np.pi)
    tilt = random.uniform(0, _MOST_TILT) * np.array([np.cos(axis), np.sin(axis), 0.0])
    return Rotation.from_rotvec(tilt) * yaw


def correspondences(
    source: Points, target: Points, T_target_source: Transform, radius: float
) -> NDArray[np.int64]:
    """Points that lie on each other in truth: indices (k, 2) into source and target.

    Args:
        source: (n, 3), metres.
        target: (m, 3), metres.
        T_target_source: true.
        radius: longest distance, metres.
    """
    moved = cKDTree(transform_points(T_target_source, source))
    pairs = moved.sparse_distance_matrix(cKDTree(target), radius, output_type="coo_matrix")
    return np.stack((pairs.row, pairs.col), axis=1).astype(np.int64)
