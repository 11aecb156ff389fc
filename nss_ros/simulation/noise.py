"""What a structured-light depth sensor makes of what it looks at.

- Lateral jitter of the pixels and quantisation of disparity: Handa et al. 2014 (A Benchmark for
  RGB-D Visual Odometry, 3D Reconstruction and SLAM, section V; after Barron and Malik 2013).
- Axial noise that grows with the square of depth: Gschwandtner et al. 2011 (BlenSor).
- Returns lost at grazing incidence, from glass, from dark surfaces far away, from metal at less
  grazing incidence, and a few anywhere.

Every ray takes the same number of draws whatever it hits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from nss_ros.config import RigConfig
from nss_ros.simulation.element import Material

Array = NDArray[np.float32]

_FAR = np.float32(1000)
"""Farther than any return, metres."""


_NORMAL = ndtri((np.arange(2**16) + 0.5) / 2**16).astype(np.float32)
"""Quantiles of the normal distribution: a table of these is faster than drawing exactly."""


@dataclass(frozen=True, slots=True)
class Draws:
    """The random part of the noise of n rays.

    Attributes:
        lateral: (2, n) float32 standard normal.
        axial: (n,) float32 standard normal.
        chance: (n,) float32 uniform in (0, 1).
    """

    lateral: Array
    axial: Array
    chance: Array


def draw_noise(count: int, rng: np.random.Generator) -> Draws:
    """Draws for so many rays, each of 16 bits."""
    raw = rng.bit_generator.random_raw(count)  # the bytes of `rng.bytes` in half the time
    bits = raw.astype("<u8", copy=False).view("<u2").reshape(4, count)
    normal = _NORMAL.take(bits[:3])
    chance = (bits[3].astype(np.float32) + np.float32(0.5)) * np.float32(2.0**-16)
    return Draws(normal[:2], normal[2], chance)


def measured_depth(depth: Array, normal: Array, config: RigConfig) -> Array:
    """Depths with axial noise, rounded to whole steps of disparity.

    Args:
        depth: (n,) true ones along the optical axis, metres, positive; inf comes out as far away.
        normal: (n,) standard normal draws.
        config: axial_noise, disparity_step, min_range.
    """
    finite = np.minimum(depth, _FAR)
    noisy = finite + normal * finite * finite * np.float32(config.axial_noise)
    np.maximum(noisy, np.float32(config.min_range / 2), out=noisy)
    if config.disparity_step == 0:
        return np.asarray(noisy)
    # Depth d has disparity proportional to 1/d; steps of one unit of `1 / disparity_step`.
    scale = np.float32(1 / config.disparity_step)
    disparity = np.rint(scale / noisy)
    return np.asarray(scale / np.maximum(disparity, np.float32(1)))


def returned(
    distance: Array,
    cosine: Array,
    materials: NDArray[np.uint8],
    uniform: Array,
    config: RigConfig,
) -> NDArray[np.bool_]:
    """Which rays give a return.

    Args:
        distance: (n,) to the surface, metres; inf without one.
        cosine: (n,) of the incidence, from 0 (grazing) to 1.
        materials: (n,) `Material` of the surface.
        uniform: (n,) draws from [0, 1).
        config: limits by range, incidence and material.
    """
    chance = _grazing(cosine, config.grazing_start, config.grazing_end)
    other = np.flatnonzero(materials)
    kinds = materials.take(other)
    metal = other[kinds == Material.METAL]
    chance[metal] = _grazing(cosine[metal], config.metal_grazing_start, config.metal_grazing_end)
    dark = other[kinds == Material.DARK]
    chance[dark] *= _falling(distance[dark], config.dark_range_start, config.dark_range_end)
    chance[other[kinds == Material.GLASS]] *= np.float32(config.glass_return)
    chance *= np.float32(1 - config.dropout)
    inside = (distance >= np.float32(config.min_range)) & (distance < _FAR)
    return np.asarray((uniform < chance) & inside)


def _grazing(cosine: Array, start: float, end: float) -> Array:
    """1 up to an incidence of `start` degrees, 0 from `end`, linear in the cosine between."""
    return _falling(-cosine, -math.cos(math.radians(start)), -math.cos(math.radians(end)))


def _falling(values: Array, start: float, end: float) -> Array:
    """1 up to `start`, 0 from `end`, linear between them."""
    slope = np.float32(1 / max(end - start, 1e-6))
    return np.asarray(np.clip((np.float32(end) - values) * slope, 0, 1), dtype=np.float32)
