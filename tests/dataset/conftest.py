"""Pairs of made-up buildings, for tests that need many pairs and no points."""

from dataclasses import dataclass

import numpy as np
import pytest

from nss_ros.dataset.pairs import PairTable
from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw


@dataclass
class Building:
    """Fragments at random spots: the nearer two are, the more they overlap."""

    poses: dict
    pairs: PairTable


def _make_building(areas=("1", "2", "3"), stages=3, spots=24, size=14.0, seed=0):
    rng = np.random.default_rng(seed)
    ids = [
        FragmentId(area, stage, spot)
        for area in areas
        for stage in range(1, stages + 1)
        for spot in range(1, spots + 1)
    ]
    poses = {
        id_: from_yaw(rng.uniform(-3, 3), (*rng.uniform(0, size, 2), 1.6)) for id_ in sorted(ids)
    }
    rows = []
    for i, source in enumerate(poses):
        for target in list(poses)[i + 1 :]:
            distance = np.linalg.norm(poses[source][:3, 3] - poses[target][:3, 3])
            overlaps = np.clip(0.85 * np.exp(-distance / 3) + rng.normal(0, 0.03, 2), 0, 1)
            if source.area == target.area and overlaps.max() > 0.01:
                typical = 0.15 if source.stage == target.stage else 0.5
                change = np.clip(rng.normal(typical, 0.1), 0, 1)
                rows.append((source, target, *overlaps, change, *rng.uniform(0.02, 0.08, 2)))
    return Building(poses, _make_table(rows))


def _make_table(rows):
    """A table of (source, target, five figures) with nothing selected."""
    ids = np.empty((2, len(rows)), dtype=object)
    figures = np.zeros((5, len(rows)))
    for i, (source, target, *numbers) in enumerate(rows):
        ids[:, i] = source, target
        figures[:, i] = numbers
    return PairTable(*ids, *figures, np.zeros(len(rows), dtype=bool))


@pytest.fixture(scope="session")
def building():
    """Three areas of three stages with 24 spots each."""
    return _make_building()


@pytest.fixture(scope="session")
def make_building():
    """Makes others."""
    return _make_building


@pytest.fixture(scope="session")
def make_table():
    """Makes a table of rows (source, target, overlap, reverse, change, complexities)."""
    return _make_table
