"""Scores of all poses on cells twice as large: ten times faster than those of a search.

Among the best twenty poses the right one is as often as among those of the fine cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.registration.gravity.correlation import correlate_turned, rotated, spectrum
from nss_ros.registration.gravity.network import as_target

#: Cells of features along each side that become one.
POOL = 2
#: Yaw angles of a full turn.
COARSE_YAWS = 60
_BATCH = 10


def pooled(features: Tensor) -> Tensor:
    """Features (..., h, w) on cells twice as large.

    The sum over the four products of small cells is about that of the means, times four.
    """
    return torch.nn.functional.avg_pool2d(features, POOL) * POOL


def coarse_scores(moving: Tensor, still: Tensor) -> Tensor:
    """Scores (COARSE_YAWS, n, n) of the poses of one square grid of features on another.

    Rows and columns are shifts of the grids' first cells against each other, modulo n; see
    `shift_of_middles`.

    Args:
        moving: (c, k, k) pooled, as a source.
        still: (c, m, m) pooled, as a source too.
    """
    size = fast_size(moving.shape[-1] + still.shape[-1])
    half = _turned(moving, size, COARSE_YAWS // 2)
    return correlate_turned(half, as_target(still), moving.shape[-1], size)


def turned_by_frequency(moving: Tensor, size: int) -> Tensor:
    """Conjugate spectra of features (c, k, k) at all yaw angles, (frequencies, COARSE_YAWS, c).

    Most of the work of `scores_of_many`, and the same for all targets of one size.

    Args:
        moving: pooled, as a source.
        size: `fast_size` of the cells of both grids.
    """
    spectra = torch.cat(list(_turned(moving, size, COARSE_YAWS))).conj()
    return spectra.flatten(2).permute(2, 0, 1).contiguous()


def scores_of_many(turned: Tensor, stills: Tensor, size: int) -> Tensor:
    """Scores (t, COARSE_YAWS, size, size) of a source on many targets: see `coarse_scores`.

    Products of matrices instead of one of numbers after the other; sums differ in the last digits.

    Args:
        turned: see `turned_by_frequency`.
        stills: (t, c, m, m) pooled, as sources; a target's scores are the same whatever the others,
            as long as they are as many.
        size: as that of `turned`.
    """
    spectra = torch.stack([spectrum(as_target(still), size) for still in stills])
    products = torch.bmm(turned, spectra.flatten(2).permute(2, 1, 0).contiguous())
    rows = products.permute(2, 1, 0).reshape(len(stills), COARSE_YAWS, size, size // 2 + 1)
    scores: Tensor = torch.fft.irfft2(rows, s=(size, size))
    return scores


def _turned(moving: Tensor, size: int, count: int) -> Iterator[Tensor]:
    """Spectra of features at the first yaw angles, in parts."""
    yaws = torch.arange(count) * (2 * math.pi / COARSE_YAWS)
    for part in torch.split(yaws, _BATCH):
        yield spectrum(rotated(moving, part), size)


def shift_of_middles(
    cells: NDArray[np.float64], moving: int, still: int, size: int
) -> NDArray[np.float64]:
    """How far the middle of a moved grid lies from that of the other, in cells.

    Args:
        cells: shifts of the first cells, modulo `size`; between cells, too.
        moving: cells along each side of the grid that is moved.
        still: of the other.
        size: at least the sum of both.
    """
    offset = (still - moving) / 2
    # The shifts at which the grids touch are from -moving to still.
    return np.where(cells < size / 2 + offset, cells, cells - size) - offset


def fast_size(least: int) -> int:
    """The next even number that has no prime factors but 2, 3 and 5."""
    size = least + least % 2
    while not _is_fast(size):
        size += 2
    return size


def _is_fast(size: int) -> bool:
    for factor in (2, 3, 5):
        while size % factor == 0:
            size //= factor
    return size == 1
