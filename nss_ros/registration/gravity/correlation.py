"""Scores of all poses of a grid over yaw, x and y, by fast Fourier transforms."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.registration.gravity.network import STRIDE, VECTORS
from nss_ros.registration.gravity.raster import CELL, SIZE

#: Yaw angles of a full turn.
YAWS = 120
STEP = CELL * STRIDE
#: Shifts along each axis: fragments that overlap at all are less than half of this apart.
SHIFTS = SIZE // STRIDE * 2
_BATCH = 24


def rotated(
    features: Tensor, yaws: Tensor, shifts: Tensor | None = None, size: int | None = None
) -> Tensor:
    """Source features turned about the middle of their grid, (k, c, size, size).

    Args:
        features: (c, n, n) float32, as a source.
        yaws: (k,) radians.
        shifts: (k, 2), x and y by which they are moved then, metres; None: not at all.
        size: cells of the result along each side, about the same middle; None: n.
    """
    cells = features.shape[-1]
    size = size or cells
    wide = size / cells
    cosines, sines = yaws.cos(), yaws.sin()
    x, y = torch.zeros(2, len(yaws)) if shifts is None else shifts.T / (STEP * cells / 2)
    # Cell u of the result is cell R(-yaw) (u - shift) of the source.
    backward = torch.stack(
        (
            torch.stack((wide * cosines, wide * sines, -cosines * x - sines * y), -1),
            torch.stack((-wide * sines, wide * cosines, sines * x - cosines * y), -1),
        ),
        1,
    )
    grid = torch.nn.functional.affine_grid(
        backward, [len(yaws), len(features), size, size], align_corners=False
    )
    turned = torch.nn.functional.grid_sample(
        features.expand(len(yaws), *features.shape), grid, mode="bilinear", align_corners=False
    )
    along_x, along_y = turned[:, VECTORS][:, 0::2], turned[:, VECTORS][:, 1::2]
    c, s = cosines[:, None, None, None], sines[:, None, None, None]
    vectors = torch.stack((c * along_x - s * along_y, s * along_x + c * along_y), dim=2).flatten(
        1, 2
    )
    return torch.cat((turned[:, : VECTORS.start], vectors, turned[:, VECTORS.stop :]), dim=1)


def spectrum(features: Tensor, shifts: int = SHIFTS) -> Tensor:
    """Fourier transform of features (..., h, w) on a grid of shifts."""
    spectra: Tensor = torch.fft.rfft2(features, s=(shifts, shifts))
    return spectra


def correlate(turned: Tensor, target: Tensor, shifts: int = SHIFTS) -> Tensor:
    """Scores (k, shifts, shifts) of shifts in y and x, each of which is taken modulo `shifts`.

    Args:
        turned: spectra (k, c, ...) of the turned source.
        target: spectrum (c, ...) of the target.
        shifts: along each axis.
    """
    # One channel after the other: the products of all of them would not stay in the cache.
    # Unbound, since the gradient of an index is as large as what it is taken from.
    first, *rest = zip(turned.unbind(1), target.unbind(0), strict=True)
    product = first[0].conj() * first[1]
    for moving, still in rest:
        product = product + moving.conj() * still
    scores: Tensor = torch.fft.irfft2(product, s=(shifts, shifts))
    return scores


def turned_spectra(source: Tensor) -> tuple[Tensor, ...]:
    """Spectra of source features (c, n, n) at the yaw angles of half a turn.

    They are most of the work of a search, and the same for all targets of a source.

    Returns:
        Parts of (YAWS / 2, c, SHIFTS, SHIFTS / 2 + 1) complex64, 86 MB; see `correlate_turned` for
        the other half.
    """
    angles = torch.split(yaw_angles()[: YAWS // 2], _BATCH)
    return tuple(spectrum(rotated(source, part)) for part in angles)


def correlate_turned(
    turned: Iterable[Tensor], target: Tensor, cells: int, shifts: int = SHIFTS
) -> Tensor:
    """Scores (yaws, shifts, shifts) of all poses of the grid.

    Turned by another half turn, maps are those of `turned` read backwards and their normals point
    the other way, so that the spectrum is the conjugate one but for signs and a phase.

    Args:
        turned: spectra of the source at the yaw angles of half a turn, in parts.
        target: features (c, n, n), as a target.
        cells: of the source along each side.
        shifts: along each axis.
    """
    still = spectrum(target, shifts)
    rows = torch.fft.fftfreq(shifts)[:, None]
    columns = torch.fft.rfftfreq(shifts)
    phase = torch.polar(torch.ones(()), 2 * math.pi * (cells - 1) * (rows + columns))
    opposite = still * phase
    opposite[VECTORS] *= -1
    pairs = [
        (correlate(part, still, shifts), correlate(part.conj(), opposite, shifts))
        for part in turned
    ]
    return torch.cat([*(first for first, _ in pairs), *(second for _, second in pairs)])


def score_parts(source: Tensor, target: Tensor, yaws: Tensor, shifts: Tensor) -> Tensor:
    """What descriptors, normals and free space add to the scores of poses, (k, 3).

    Args:
        source: (c, n, n), as a source.
        target: (c, m, m), as a target.
        yaws: (k,) radians.
        shifts: (k, 2), x and y, metres.
    """
    products = (rotated(source, yaws, shifts, target.shape[-1]) * target).sum(dim=(2, 3))
    groups = (products[:, : VECTORS.start], products[:, VECTORS], products[:, VECTORS.stop :])
    return torch.stack([each.sum(dim=1) for each in groups], dim=1)


def planar(transforms: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    """Yaws (k,), radians, and shifts (k, 2), metres, of transforms (k, 4, 4)."""
    yaws = np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0])
    return torch.from_numpy(yaws).float(), torch.from_numpy(transforms[:, :2, 3]).float()


def yaw_angles() -> Tensor:
    """The yaw angles of the grid, (YAWS,) float32, radians."""
    return torch.arange(YAWS) * (2 * math.pi / YAWS)


def shift_of(cell: float) -> float:
    """The shift of a cell of the grid, metres; between cells, too."""
    return (cell - SHIFTS if cell >= SHIFTS // 2 else cell) * STEP
