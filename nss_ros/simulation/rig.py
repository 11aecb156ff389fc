"""The scanner: three depth sensors pitched -30, 0 and +30 degrees, turned to six azimuths.

One spot gives 18 depth images, ray-cast with Open3D (Embree) and fused in the sensor frame
(x forward at heading zero, z up). The frame of every depth image is x forward, y left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from nss_ros.config import RigConfig
from nss_ros.geometry import Transform, from_rotation
from nss_ros.simulation.noise import draw_noise, measured_depth, returned
from nss_ros.simulation.scene import Scene

PITCHES = (-30.0, 0.0, 30.0)
AZIMUTHS = (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)


@dataclass(frozen=True, slots=True)
class Returns:
    """What the 18 depth images of one spot measure, as one cloud, in the order of the pixels.

    Attributes:
        points: (n, 3) float32, metres, sensor frame.
        normals: (n, 3) float32 unit normals of the surfaces, towards the sensor, sensor frame.
        triangles: (n,) indices of the triangles of the scene.
        ranges: (n,) float32, distances from the sensor, metres.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    ranges: NDArray[np.float32]

    def within(self, distance: float) -> Returns:
        """Those no farther from the sensor than a distance in metres."""
        kept = np.flatnonzero(self.ranges <= np.float32(distance))
        return Returns(
            self.points.T.take(kept, axis=1).T,
            self.normals.T.take(kept, axis=1).T,
            self.triangles.take(kept),
            self.ranges.take(kept),
        )


def draw_pose(place: ArrayLike, config: RigConfig, rng: np.random.Generator) -> Transform:
    """`T_map_fragment` of a tripod put on the floor at (x, y, z): any heading, almost level."""
    position = np.array(place, dtype=np.float64)
    position[2] += rng.uniform(config.min_tripod_height, config.max_tripod_height)
    heading = rng.uniform(-np.pi, np.pi)
    tilt = rng.normal(0.0, np.radians(config.tilt), 2)
    rotation = Rotation.from_euler("z", heading) * Rotation.from_rotvec([*tilt, 0.0])
    return from_rotation(rotation, position)


def image_directions(config: RigConfig) -> NDArray[np.float32]:
    """Rays of one depth image, (3, h * w) with x = 1, so that a depth times a ray is a point."""
    half_width = math.tan(math.radians(config.horizontal_fov / 2))
    half_height = math.tan(math.radians(config.vertical_fov / 2))
    columns = (np.arange(config.image_width) + 0.5) / config.image_width * 2 - 1
    rows = (np.arange(config.image_height) + 0.5) / config.image_height * 2 - 1
    directions = np.ones((3, config.image_height, config.image_width), dtype=np.float32)
    directions[1] = -columns * half_width
    directions[2] = -rows[:, None] * half_height
    return directions.reshape(3, -1)


def image_rotations() -> NDArray[np.float64]:
    """Rotations from the 18 image frames to the sensor frame, (18, 3, 3); pitch up positive."""
    angles = [(azimuth, -pitch) for pitch in PITCHES for azimuth in AZIMUTHS]
    return np.asarray(Rotation.from_euler("ZY", angles, degrees=True).as_matrix())


def scan(
    scene: Scene,
    T_map_fragment: Transform,
    config: RigConfig,
    rng: np.random.Generator,
    reach: float | None = None,
) -> Returns:
    """All that the 18 images of one spot measure.

    Args:
        scene: the site at one stage, map frame.
        T_map_fragment: pose of the sensor.
        config: field of view, resolution, range and noise.
        rng: of the noise; how much is drawn does not depend on what is seen, nor on `reach`.
        reach: points farther away are cut, metres; `max_range` if missing.
    """
    reach = config.max_range if reach is None else reach
    nominal = image_directions(config)
    lengths = np.linalg.norm(nominal, axis=0)
    # One by one, and a row per axis: the arrays of an image stay in the processor's cache.
    images = [
        _image(scene, T_map_fragment, rotation, (nominal, lengths), config, rng, reach)
        for rotation in image_rotations()
    ]
    points, normals, triangles, ranges = zip(*images, strict=True)
    return Returns(
        np.concatenate(points, axis=1).T,
        np.concatenate(normals, axis=1).T,
        np.concatenate(triangles),
        np.concatenate(ranges),
    )


def _image(
    scene: Scene,
    T_map_fragment: Transform,
    rotation: NDArray[np.float64],
    directions: tuple[NDArray[np.float32], NDArray[np.float32]],
    config: RigConfig,
    rng: np.random.Generator,
    reach: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32]]:
    """Points and normals (3, n) of one image, sensor frame, their triangles and ranges (n,).

    Args:
        scene: the site, map frame.
        T_map_fragment: pose of the sensor.
        rotation: (3, 3) from the image frame to the sensor frame.
        directions: nominal rays of the image, and their lengths.
        config: range and noise.
        rng: of the noise.
        reach: points farther away are cut, metres.
    """
    nominal, lengths = directions
    draws = draw_noise(len(lengths), rng)
    cast = nominal.copy()
    cast[1:] += draws.lateral * np.float32(np.radians(config.lateral_noise))
    into_map = (T_map_fragment[:3, :3] @ rotation).astype(np.float32)
    hits = scene.cast(T_map_fragment[:3, 3], (into_map @ cast).T)
    normals = into_map.T @ hits.normals.T
    cosine = -(normals * cast).sum(axis=0) / lengths
    depth = measured_depth(hits.distances, draws.axial, config)
    back = returned(
        hits.distances * lengths, np.abs(cosine), scene.material_of(hits), draws.chance, config
    )
    ranges = depth * lengths
    kept = np.flatnonzero(back & (ranges <= np.float32(reach)))
    points = nominal.take(kept, axis=1) * depth.take(kept)
    # Towards the sensor, whichever way the mesh has them.
    facing = normals.take(kept, axis=1) * np.sign(cosine.take(kept))
    into_sensor = rotation.astype(np.float32)
    return (
        into_sensor @ points,
        into_sensor @ facing,
        hits.triangles.take(kept),
        ranges.take(kept),
    )
