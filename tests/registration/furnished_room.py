"""A small furnished room, as points on its surfaces."""

import numpy as np

BOXES = (
    ((0.0, 0.0, 1.4), (5.0, 4.0, 2.8)),
    ((1.6, 1.2, -0.4), (0.9, 0.5, 1.2)),
    ((-1.8, 0.9, 0.0), (0.4, 1.3, 2.0)),
    ((0.4, -1.3, -0.6), (1.5, 0.6, 0.8)),
    ((-1.2, -1.5, -0.2), (0.3, 0.3, 1.7)),
    ((2.1, -0.8, 0.3), (0.6, 0.9, 0.4)),
)


def box_surface(center, size, spacing, random):
    half = np.asarray(size) / 2
    faces = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        count = int(4 * half[first] * half[second] / spacing**2)
        for side in (-1, 1):
            face = random.uniform(-1, 1, (count, 3)) * half
            face[:, axis] = side * half[axis]
            faces.append(face)
    return np.vstack(faces) + center


def room(seed=0, spacing=0.09):
    """Points (n, 3) of the room, seen from about its middle; the sensor is the origin."""
    random = np.random.default_rng(seed)
    hull, *furniture = BOXES
    center = (hull[0][0], hull[0][1], 0.2)
    parts = [box_surface(center, hull[1], spacing, random)]
    parts += [box_surface(*box, spacing, random) for box in furniture]
    points = np.vstack(parts)
    return (points + random.normal(0, 0.003, points.shape)).astype(np.float32)
