"""The best poses of an exhaustive search over yaw, x and y."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.registration.gravity.correlation import (
    SHIFTS,
    YAWS,
    correlate,
    rotated,
    shift_of,
    spectrum,
    yaw_angles,
)

# Poses closer than this to a better one are the same hypothesis, in cells of the grid.
_APART_YAWS, _APART_CELLS = 3, 2
_SHAPE = np.array([YAWS, SHIFTS, SHIFTS])
_BATCH = 24
_PEAKS = 4000


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


def search(source: Tensor, target: Tensor, count: int) -> Search:
    """The `count` best poses of a source's features on a target's.

    Args:
        source: (c, h, w) float32, as a source.
        target: (c, h, w) float32, as a target.
        count: most peaks.
    """
    with torch.inference_mode():
        spectra = spectrum(target)
        angles = yaw_angles()
        scores = torch.cat(
            [
                correlate(spectrum(rotated(source, part)), spectra)
                for part in torch.split(angles, _BATCH)
            ]
        )
        total = float(scores.flatten().logsumexp(dim=0))
        values, places = scores.flatten().topk(_PEAKS)
    grid = np.stack(np.unravel_index(places.numpy(), scores.shape), axis=1)
    peaks = _peaks(grid, values.numpy().astype(np.float64), total, count)
    return Search(peaks, total - math.log(scores.numel()))


def _peaks(
    places: NDArray[np.intp], values: NDArray[np.float64], total: float, count: int
) -> tuple[Peak, ...]:
    """Greedy suppression of what lies beside a better pose."""
    left = np.ones(len(places), dtype=bool)
    peaks: list[Peak] = []
    while left.any() and len(peaks) < count:
        best = int(np.argmax(left))  # the values descend
        offsets = (places - places[best] + _SHAPE // 2) % _SHAPE - _SHAPE // 2
        beside = left & (np.abs(offsets) <= (_APART_YAWS, _APART_CELLS, _APART_CELLS)).all(axis=1)
        mass = float(np.logaddexp.reduce(values[beside])) - total
        left &= ~beside
        touching = (np.abs(offsets) <= 1).all(axis=1)
        weights = np.exp(values[touching] - values[best])
        # Between the cells: the mean pose of the cell and those that touch it.
        exact = places[best] + weights @ offsets[touching] / weights.sum()
        peaks.append(
            Peak(
                float(exact[0]) * 2 * math.pi / YAWS,
                shift_of(float(exact[2])),
                shift_of(float(exact[1])),
                float(values[best]),
                mass,
            )
        )
    return tuple(peaks)
