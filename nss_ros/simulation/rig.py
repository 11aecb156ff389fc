"""The scanner: three depth sensors pitched -30, 0 and +30 degrees, turned to six azimuths.

One spot gives 18 depth images, ray-cast with Open3D (Embree) and fused in the sensor frame
(x forward at heading zero, z up). The frame of every depth image is x forward, y left, z up.

Noise, per ray: lateral jitter and disparity quantisation as in Handa et al. 2014 (ICL-NUIM);
axial noise that grows with the square of depth (Nguyen et al. 2012; Gschwandtner et al. 2011);
returns lost at grazing incidence, out of range, and a few anywhere.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nss_ros.config import RigConfig
from nss_ros.fragment import Points
from nss_ros.geometry import Transform, from_rotation
from nss_ros.simulation.scene import Scene

PITCHES = (-30.0, 0.0, 30.0)
AZIMUTHS = (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)


def draw_pose(
    position: NDArray[np.float64], config: RigConfig, rng: np.random.Generator
) -> Transform:
    """`T_map_fragment` of a tripod put on the floor at (x, y): any heading, almost level."""
    height = rng.uniform(config.min_tripod_height, config.max_tripod_height)
    heading = rng.uniform(-np.pi, np.pi)
    tilt = rng.normal(0.0, np.radians(config.tilt), 2)
    rotation = Rotation.from_euler("z", heading) * Rotation.from_rotvec([*tilt, 0.0])
    return from_rotation(rotation, (*position, height))


def image_directions(config: RigConfig) -> NDArray[np.float64]:
    """Rays of one depth image, (h * w, 3) with x = 1, so that a depth times a ray is a point."""
    half_width = math.tan(math.radians(config.horizontal_fov / 2))
    half_height = math.tan(math.radians(config.vertical_fov / 2))
    columns = (np.arange(config.image_width) + 0.5) / config.image_width * 2 - 1
    rows = (np.arange(config.image_height) + 0.5) / config.image_height * 2 - 1
    directions = np.ones((config.image_height, config.image_width, 3))
    directions[..., 1] = -columns * half_width
    directions[..., 2] = -rows[:, None] * half_height
    return directions.reshape(-1, 3)


def image_rotations() -> NDArray[np.float64]:
    """Rotations from the 18 image frames to the sensor frame, (18, 3, 3); pitch up positive."""
    angles = [(azimuth, -pitch) for pitch in PITCHES for azimuth in AZIMUTHS]
    return np.asarray(Rotation.from_euler("ZY", angles, degrees=True).as_matrix())


def scan(
    scene: Scene, T_map_fragment: Transform, config: RigConfig, rng: np.random.Generator
) -> Points:
    """All points of one spot in the sensor frame, (n, 3) float32, as the 18 images give them.

    Args:
        scene: the site at one stage, map frame.
        T_map_fragment: pose of the sensor.
        config: field of view, resolution, range and noise.
        rng: of the noise.
    """
    nominal = image_directions(config)
    rotations = image_rotations()
    cast = nominal[None] + np.zeros((len(rotations), 1, 1))
    cast[..., 1:] += rng.normal(0.0, np.radians(config.lateral_noise), cast[..., 1:].shape)
    into_map = T_map_fragment[:3, :3] @ rotations
    map_directions = np.einsum("kij,knj->kni", into_map, cast).reshape(-1, 3)
    lengths = np.linalg.norm(map_directions, axis=1)
    depth, normals = scene.cast(T_map_fragment[:3, 3], map_directions)
    cosine = np.abs(np.einsum("ni,ni->n", normals, map_directions)) / lengths
    kept = _returned(depth * lengths, cosine, config, rng)
    measured = _measured(depth, config, rng).reshape(len(rotations), -1)
    points = np.einsum("kij,knj->kni", rotations, measured[..., None] * nominal[None])
    return np.asarray(points.reshape(-1, 3)[kept], dtype=np.float32)


def _returned(
    distance: NDArray[np.float64],
    cosine: NDArray[np.float64],
    config: RigConfig,
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Which rays give a return, by range and by chance that falls with grazing incidence."""
    in_range = (distance >= config.min_range) & (distance <= config.max_range)
    incidence = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
    span = max(config.grazing_end - config.grazing_start, 1e-6)
    chance = (1 - config.dropout) * np.clip((config.grazing_end - incidence) / span, 0.0, 1.0)
    return np.asarray(in_range & (rng.random(len(distance)) < chance))


def _measured(
    depth: NDArray[np.float64], config: RigConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Depth with axial noise, then rounded to whole steps of disparity."""
    finite = np.where(np.isfinite(depth), depth, config.max_range)
    noise = rng.normal(0.0, 1.0, len(finite)) * config.axial_noise * finite**2
    noisy = np.maximum(finite + noise, config.min_range / 2)
    if config.disparity_step == 0:
        return np.asarray(noisy)
    # Depth d has disparity proportional to 1/d; steps of one unit of `1 / disparity_step`.
    disparity = np.maximum(np.rint(1 / (noisy * config.disparity_step)), 1.0)
    return np.asarray(1 / (disparity * config.disparity_step))
