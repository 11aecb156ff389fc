"""Pairs with ground truth to train the gravity method on, from simulated datasets.

Only training reads this: nothing here is imported by a method or a node. The datasets must be
simulated sites of their own, never those that a benchmark is run on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.config import RegistrationConfig
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, relative, transform_points
from nss_ros.parallel import run
from nss_ros.registration.gravity.raster import CELL
from nss_ros.registration.gravity.scan import LevelScan, fitting_scan_of

_OVERLAP_POINTS = 1000
# Between the sensors of a pair, as a share of how far their maps reach: 7 m for usual ones.
_MOST_DISTANCE = 7.0 / 4.8
_MOST_ATTEMPTS = 1000


@dataclass(frozen=True, slots=True)
class Item:
    """A fragment to train on.

    Attributes:
        dataset: number of its dataset; areas of two datasets have nothing in common.
        scan: what the method makes of it.
        T_map_fragment: its true pose.
    """

    dataset: int
    scan: LevelScan
    T_map_fragment: Transform


@dataclass(frozen=True, slots=True)
class Example:
    """A pair to train on.

    Attributes:
        source: index of its item.
        target: index of its item.
        same_stage: both are of one stage.
        overlap_ratio: share of the points with a neighbour within 0.2 m, the larger of both ways.
    """

    source: int
    target: int
    same_stage: bool
    overlap_ratio: float


def read_items(folders: Iterable[Path], config: RegistrationConfig, workers: int) -> list[Item]:
    """All fragments of datasets, prepared."""
    items = []
    for number, folder in enumerate(folders):
        dataset = DatasetFolder(folder)
        poses = dataset.poses()
        calls = [(folder, each, config) for each in poses]
        for each, scan in zip(poses, run(_prepare, calls, workers), strict=True):
            items.append(Item(number, scan, poses[each]))
    return items


def _prepare(call: tuple[Path, FragmentId, RegistrationConfig]) -> LevelScan:
    folder, fragment, config = call
    return fitting_scan_of(DatasetFolder(folder).fragment(fragment), config)


def relative_truth(items: list[Item], source: int, target: int) -> Transform:
    """`T_target_source`, the ground truth."""
    return relative(items[source].T_map_fragment, items[target].T_map_fragment)


class ExampleSource:
    """Draws pairs of overlapping fragments.

    Args:
        items: the fragments.
        seed: of the draws.
        different_share: share of the pairs that are of different stages.
        min_overlap: least overlap ratio.
    """

    def __init__(
        self, items: list[Item], seed: int, different_share: float = 0.65, min_overlap: float = 0.1
    ) -> None:
        self.items = items
        self._rng = np.random.default_rng(seed)
        self._different_share = different_share
        self._min_overlap = min_overlap
        self._near = [self._neighbours(number) for number in range(len(items))]

    def draw(self) -> Example:
        """One pair of those near each other that overlap; small overlaps are the most common.

        Raises:
            InputError: there is hardly any.
        """
        for _ in range(_MOST_ATTEMPTS):
            source = int(self._rng.integers(len(self.items)))
            same_stage = bool(self._rng.random() >= self._different_share)
            near = self._near[source][int(same_stage)]
            if len(near) == 0:
                continue
            target = int(self._rng.choice(near))
            ratio = overlap(self.items, source, target)
            if ratio < self._min_overlap:
                continue
            return Example(source, target, same_stage, ratio)
        raise InputError(
            "The training datasets hold too few fragments that overlap within a stage and across "
            "stages: simulate more spots, or more stages."
        )

    def draw_apart(self) -> Example:
        """A pair of fragments that do not overlap, of one area or of two.

        Raises:
            InputError: there is hardly any.
        """
        for _ in range(_MOST_ATTEMPTS):
            first, second = (int(each) for each in self._rng.integers(len(self.items), size=2))
            a, b = self.items[first], self.items[second]
            together = a.dataset == b.dataset and a.scan.id.area == b.scan.id.area
            if first == second or (together and overlap(self.items, first, second) > 0.01):
                continue
            same_stage = together and a.scan.id.stage == b.scan.id.stage
            return Example(first, second, same_stage, 0.0)
        raise InputError(
            "The training datasets hold too few fragments that do not overlap: simulate more areas."
        )

    def _neighbours(self, source: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices of items near one, of different stages and of its stage."""
        mine = self.items[source]
        farthest = _MOST_DISTANCE * CELL * mine.scan.maps.shape[-1] / 2
        near = [
            number
            for number, item in enumerate(self.items)
            if number != source
            and item.dataset == mine.dataset
            and item.scan.id.area == mine.scan.id.area
            and np.hypot(*(item.T_map_fragment - mine.T_map_fragment)[:2, 3]) < farthest
        ]
        same = [self.items[each].scan.id.stage == mine.scan.id.stage for each in near]
        found = np.array(near, dtype=np.intp)
        mask = np.array(same, dtype=bool)
        return found[~mask], found[mask]


def overlap(items: list[Item], source: int, target: int, tau: float = 0.2) -> float:
    """Overlap ratio by the true poses, on some of the points."""
    transform = relative_truth(items, source, target)
    moving, still = items[source].scan.points, items[target].scan.points
    moved = transform_points(transform, moving)
    return max(_share(moved, still, tau), _share(still, moved, tau))


def _share(points: NDArray[np.floating], others: NDArray[np.floating], tau: float) -> float:
    step = max(len(points) // _OVERLAP_POINTS, 1)
    distances, _ = cKDTree(others).query(points[::step], distance_upper_bound=tau)
    return float(np.isfinite(distances).mean())
