"""The best poses of an exhaustive search over yaw, x and y."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.registration.gravity.correlation import (
    YAWS,
    correlate_turned,
    shift_of,
)

# Poses closer than this to a better one are the same hypothesis, in cells of the grid.
_APART_YAWS, _APART_CELLS = 3, 2
_PEAKS = 4000
# Weights stay finite, however large scores are.
_MOST_BETTER = 500.0


@dataclass(frozen=True, slots=True)
class Peak:
    """A pose that the search found.

    Attributes:
        yaw: of `T_target_source`, radians.
        x: metres, target frame.
        y: metres, target frame.
        score: logarithm of its probability density before refinement, up to a constant.
        mass: logarithm of the probability of all poses beside it, among all poses of the grid.
    """

    yaw: float
    x: float
    y: float
    score: float
    mass: float


@dataclass(frozen=True, slots=True)
class Search:
    """Outcome of a search.

    Attributes:
        peaks: best first.
        evidence: logarithm of the sum over all poses, against the mean pose of two fragments
            that have nothing in common.
    """

    peaks: tuple[Peak, ...]
    evidence: float


def search(turned: Sequence[Tensor], target: Tensor, count: int) -> Search:
    """The `count` best poses of a source's features on a target's.

    Args:
        turned: spectra of the source, see `turned_spectra`.
        target: (c, n, n) float32, as a target; the source's maps are as large.
        count: most peaks.
    """
    with torch.inference_mode():
        scores = correlate_turned(turned, target, target.shape[-1])
        places = best_places(scores, count)
        total = float(scores.flatten().logsumexp(dim=0))
    peaks = tuple(
        Peak(
            float(each.cells[0]) * 2 * math.pi / YAWS,
            shift_of(float(each.cells[2])),
            shift_of(float(each.cells[1])),
            each.score,
            each.mass - total,
        )
        for each in places
    )
    return Search(peaks, total - math.log(scores.numel()))


@dataclass(frozen=True, slots=True)
class Place:
    """A peak of scores.

    Attributes:
        cells: (3,) float64, yaw, row and column; between the cells, too.
        score: of its best cell.
        mass: logarithm of the sum beside it.
    """

    cells: NDArray[np.float64]
    score: float
    mass: float


def best_places(scores: Tensor, count: int) -> list[Place]:
    """The `count` best peaks of scores (yaws, rows, columns), all of them cyclic, best first."""
    best, numbers = scores.flatten().topk(min(_PEAKS, scores.numel()))
    shape = np.array(scores.shape)
    grid = np.stack(np.unravel_index(numbers.numpy(), scores.shape), axis=1)
    values = best.numpy().astype(np.float64)
    left = np.ones(len(grid), dtype=bool)
    found: list[Place] = []
    while left.any() and len(found) < count:
        top = int(np.argmax(left))  # the values descend
        offsets = (grid - grid[top] + shape // 2) % shape - shape // 2
        beside = left & (np.abs(offsets) <= (_APART_YAWS, _APART_CELLS, _APART_CELLS)).all(axis=1)
        left &= ~beside
        touching = (np.abs(offsets) <= 1).all(axis=1)
        # A cell of a better peak may touch it.
        weights = np.exp(np.minimum(values[touching] - values[top], _MOST_BETTER))
        # Between the cells: the mean pose of the cell and those that touch it.
        cells = grid[top] + weights @ offsets[touching] / weights.sum()
        mass = float(np.logaddexp.reduce(values[beside]))
        found.append(Place(cells, float(values[top]), mass))
    return found
