"""Point clouds that no method can register, by name, each (n, 3)."""

import numpy as np


def line(count):
    return np.linspace(0, 8, count)[:, None] * np.array([[1.0, 0.3, 0.1]])


def plane(count, noise=0.0):
    random = np.random.default_rng(0)
    points = random.uniform(-3, 3, (count, 3))
    points[:, 2] = random.normal(-1.5, noise, count) if noise else -1.5
    return points


BAD = {
    "empty": np.zeros((0, 3)),
    "one point": np.ones((1, 3)),
    "no finite point": np.full((500, 3), np.nan),
    "equal points": np.ones((500, 3)),
    "line": line(4000),
    "plane": plane(8000),
    "noisy plane": plane(4000, 0.005),
    "two far points": np.array([[0, 0, 0], [1e6, 0, 0]]),
    "scattered": np.random.default_rng(0).uniform(-500, 500, (500, 3)),
}
