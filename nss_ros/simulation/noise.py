"""What a structured-light depth sensor makes of what it looks at.

- Lateral jitter of the pixels and quantisation of disparity: Handa et al. 2014 (A Benchmark for
  RGB-D Visual Odometry, 3D Reconstruction and SLAM, section V; after Barron and Malik 2013).
- Axial noise that grows with the square of depth: Gschwandtner et al. 2011 (BlenSor).
- Returns lost at grazing incidence, from glass, from dark surfaces far away, from metal at less
  grazing incidence, and a few anywhere.

Every ray takes the same number of draws whatever it hits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RigConfig
from nss_ros.simulation.element import Material

Array = NDArray[np.float32]


def lateral_jitter(shape: tuple[int, ...], config: RigConfig, rng: np.random.Generator) -> Array:
    """Shifts of rays with x = 1 along y and z, in units of x; of any shape, normal."""
    jitter = rng.standard_normal(shape, dtype=np.float32)
    jitter *= np.float32(np.radians(config.lateral_noise))
    return jitter


def measured_depth(depth: Array, normal: Array, config: RigConfig) -> Array:
    """Depths with axial noise, rounded to whole steps of disparity.

    Args:
        depth: (n,) true ones along the optical axis, metres, positive.
        normal: (n,) standard normal draws.
        config: axial_noise, disparity_step, min_range.
    """
    noisy = depth + normal * depth * depth * np.float32(config.axial_noise)
    np.maximum(noisy, np.float32(config.min_range / 2), out=noisy)
    if config.disparity_step == 0:
        return noisy
    # Depth d has disparity proportional to 1/d; steps of one unit of `1 / disparity_step`.
    scale = np.float32(1 / config.disparity_step)
    disparity = np.rint(scale / noisy)
    return np.asarray(scale / np.maximum(disparity, np.float32(1)))


def deepest_error(distance: float, config: RigConfig) -> float:
    """More than the depth noise that any ray gets at a distance, metres."""
    return (8 * config.axial_noise + config.disparity_step) * distance**2


def returned(
    distance: Array,
    cosine: Array,
    materials: NDArray[np.uint8],
    uniform: Array,
    config: RigConfig,
) -> NDArray[np.bool_]:
    """Which rays give a return.

    Args:
        distance: (n,) to the surface, metres.
        cosine: (n,) of the incidence, from 0 (grazing) to 1.
        materials: (n,) `Material` of the surface.
        uniform: (n,) draws from [0, 1).
        config: limits by range, incidence and material.
    """
    incidence = np.degrees(np.arccos(np.minimum(cosine, np.float32(1))))
    chance = _falling(incidence, config.grazing_start, config.grazing_end)
    metal = np.flatnonzero(materials == Material.METAL)
    chance[metal] = _falling(incidence[metal], config.metal_grazing_start, config.metal_grazing_end)
    dark = np.flatnonzero(materials == Material.DARK)
    chance[dark] *= _falling(distance[dark], config.dark_range_start, config.dark_range_end)
    chance[materials == Material.GLASS] *= np.float32(config.glass_return)
    chance *= np.float32(1 - config.dropout)
    return np.asarray((uniform < chance) & (distance >= np.float32(config.min_range)))


def _falling(values: Array, start: float, end: float) -> Array:
    """1 up to `start`, 0 from `end`, linear between them."""
    slope = np.float32(1 / max(end - start, 1e-6))
    return np.asarray(np.clip((np.float32(end) - values) * slope, 0, 1), dtype=np.float32)
