"""Scores of all poses of a grid over yaw, x and y, by fast Fourier transforms."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nss_ros.registration.gravity.network import STRIDE, VECTORS
from nss_ros.registration.gravity.raster import CELL, SIZE

#: Yaw angles of a full turn.
YAWS = 120
STEP = CELL * STRIDE
#: Shifts along each axis: fragments that overlap at all are less than half of this apart.
SHIFTS = SIZE // STRIDE * 2


def rotated(features: Tensor, yaws: Tensor) -> Tensor:
    """Source features turned about the sensor, (k, c, h, w).

    Args:
        features: (c, h, w) float32, as a source.
        yaws: (k,) radians.
    """
    cosines, sines = yaws.cos(), yaws.sin()
    zero = torch.zeros_like(yaws)
    # Cell x of the result is cell R(-yaw) x of the source.
    backward = torch.stack(
        (torch.stack((cosines, sines, zero), -1), torch.stack((-sines, cosines, zero), -1)), 1
    )
    shape = (len(yaws), *features.shape)
    grid = torch.nn.functional.affine_grid(backward, list(shape), align_corners=False)
    turned = torch.nn.functional.grid_sample(
        features.expand(shape), grid, mode="bilinear", align_corners=False
    )
    x, y = turned[:, VECTORS][:, 0::2], turned[:, VECTORS][:, 1::2]
    c, s = cosines[:, None, None, None], sines[:, None, None, None]
    vectors = torch.stack((c * x - s * y, s * x + c * y), dim=2).flatten(1, 2)
    return torch.cat((turned[:, : VECTORS.start], vectors, turned[:, VECTORS.stop :]), dim=1)


def spectrum(features: Tensor) -> Tensor:
    """Fourier transform of features (..., h, w) on the grid of shifts."""
    spectra: Tensor = torch.fft.rfft2(features, s=(SHIFTS, SHIFTS))
    return spectra


def correlate(turned: Tensor, target: Tensor) -> Tensor:
    """Scores (k, SHIFTS, SHIFTS) of shifts in y and x, each of which is taken modulo SHIFTS.

    Args:
        turned: spectra (k, c, ...) of the turned source.
        target: spectrum (c, ...) of the target.
    """
    product = (turned.conj() * target).sum(dim=1)
    scores: Tensor = torch.fft.irfft2(product, s=(SHIFTS, SHIFTS))
    return scores


def yaw_angles() -> Tensor:
    """The yaw angles of the grid, (YAWS,) float32, radians."""
    return torch.arange(YAWS) * (2 * math.pi / YAWS)


def shift_of(cell: int) -> float:
    """The shift of a cell of the grid, metres."""
    return (cell - SHIFTS if cell >= SHIFTS // 2 else cell) * STEP
