"""Point clouds that no method can register, by name, each (n, 3)."""

import numpy as np

from nss_ros.fragment import Fragment, FragmentId
from nss_ros.registration.relative_transform import Reason

_REASONS = (Reason.TOO_FEW_POINTS, Reason.TOO_FEW_INLIERS, Reason.NOT_LEVEL)


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


def assert_fails_cleanly(method, cloud, scan):
    """A method answers a bad cloud (n, 3) and a good scan, either way, with a reason."""
    bad = method.prepare(Fragment(FragmentId("1", 2, 0), cloud.astype(np.float32), True))
    good = method.prepare(scan)
    for source, target in ((bad, good), (good, bad), (bad, bad)):
        result = method.register(source, target, 0)
        assert result.reason in _REASONS
        assert result.message.endswith(".")
        assert np.array_equal(result.T_target_source, np.eye(4))
