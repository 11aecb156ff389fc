"""A choice of pairs in which easy and hard ones are about equally many.

Of all pairs of a building most overlap little and changed little. As in the NSS paper, the pairs
of the benchmark are chosen so that the joint histogram of overlap ratio and temporal change ratio
(on request of complexity too) is as flat as the pairs allow, for same-stage and different-stage
pairs apart: every cell gives all its pairs, or as many as the other cells that have enough.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import PairConfig
from nss_ros.dataset.pairs import Mask, PairTable

_KINDS = ("same_stage", "different_stage")


def select_pairs(pairs: PairTable, config: PairConfig, seed: int) -> PairTable:
    """The same pairs, those selected that make the joint histogram flat.

    The choice depends on the pairs and the seed, not on the order of the rows.

    Args:
        pairs: all pairs.
        config: least overlap, bins, and how many to choose.
        seed: of the draw within each cell.
    """
    selected = np.zeros(len(pairs), dtype=bool)
    cells = _cells(pairs, config)
    for number, rows in enumerate(_eligible(pairs, config)):
        count = (config.selection.same_stage_pairs, config.selection.different_stage_pairs)[number]
        count = count or round(config.selection.share * len(rows))
        rng = np.random.default_rng((seed, number))
        selected[rows[_flat_choice(cells[rows], count, rng)]] = True
    return pairs.select(selected)


def selection_flatness(pairs: PairTable, config: PairConfig) -> dict[str, tuple[float, float]]:
    """How flat the joint histogram is, of all eligible and of the selected pairs.

    Args:
        pairs: with a selection.
        config: what `select_pairs` was given.

    Returns:
        For "same_stage" and "different_stage" the entropy before and after, as a share of the
        largest possible (all cells that hold eligible pairs alike); NaN where there is no pair.
    """
    cells = _cells(pairs, config)
    result = {}
    for kind, rows in zip(_KINDS, _eligible(pairs, config), strict=True):
        chosen = rows[pairs.selected[rows]]
        occupied = len(np.unique(cells[rows]))
        result[kind] = (_flatness(cells[rows], occupied), _flatness(cells[chosen], occupied))
    return result


def _eligible(pairs: PairTable, config: PairConfig) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of enough overlap, in canonical order of the pairs: same stage, different stages."""
    names = pairs.pairs
    order = np.array(sorted(range(len(names)), key=names.__getitem__), dtype=np.int64)
    enough: Mask = pairs.overlap_ratio >= config.min_overlap
    same = pairs.same_stage
    return order[(enough & same)[order]], order[(enough & ~same)[order]]


def _cells(pairs: PairTable, config: PairConfig) -> NDArray[np.int64]:
    """The cell of the joint histogram that each pair falls into, (n,)."""
    bins = config.selection
    overlap = _bin(pairs.overlap_ratio, config.min_overlap, 1.0, bins.overlap_bins)
    change = _bin(pairs.temporal_change, 0.0, 1.0, bins.change_bins)
    complexity = _bin(pairs.complexity, 0.0, bins.complexity_limit, bins.complexity_bins)
    # One more bin each for what is not a number.
    return (overlap * (bins.change_bins + 1) + change) * (bins.complexity_bins + 1) + complexity


def _bin(values: NDArray[np.float64], low: float, high: float, bins: int) -> NDArray[np.int64]:
    width = (high - low) / bins or 1.0
    index = np.clip((np.nan_to_num(values) - low) / width, 0, bins - 1).astype(np.int64)
    return np.where(np.isnan(values), bins, index)


def _flat_choice(
    cells: NDArray[np.int64], count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Indices of `count` entries (or all), as evenly from all cells as they allow."""
    mixed = rng.permutation(len(cells))
    # The rank of each entry within its cell, in random order: taking entries by their rank fills
    # all cells alike, and the random order decides within the last rank.
    by_cell = mixed[np.argsort(cells[mixed], kind="stable")]
    _, starts, sizes = np.unique(cells[by_cell], return_index=True, return_counts=True)
    rank = np.empty(len(cells), dtype=np.int64)
    rank[by_cell] = np.arange(len(cells)) - np.repeat(starts, sizes)
    return mixed[np.argsort(rank[mixed], kind="stable")][:count]


def _flatness(cells: NDArray[np.int64], occupied: int) -> float:
    if len(cells) == 0:
        return float("nan")
    shares = np.unique(cells, return_counts=True)[1] / len(cells)
    if occupied == 1:
        return 1.0
    return float(-(shares * np.log(shares)).sum() / np.log(occupied))
