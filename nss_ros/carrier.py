"""What carries a scanner, as far as the scanner sees it: a robot, a trolley, the legs of a tripod.

It goes with the scanner from spot to spot, so that every right pose of two fragments has the one's
carrier in space that the other saw to be empty, and the pose that lays both scanners on each other
has the carriers agree. It lies below the sensor, nearer than any floor a tripod stands on; what
else may be there is the foot of something beside it, which a fragment can do without.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import Points

# Everything within the first distance of the sensor, metres, and within the second of it what is
# at least so far below the horizon.
_TOUCHING, _BENEATH = 0.3, 1.0
_BELOW = np.sin(np.radians(25.0))


def without_carrier(points: Points) -> Points:
    """The points that are not of what carries the scanner.

    Args:
        points: (n, 3) float32, metres, sensor frame, z up.
    """
    return points[~_is_carrier(points)]


def _is_carrier(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    distance = np.linalg.norm(points, axis=1)
    beneath = (distance < _BENEATH) & (points[:, 2] < -_BELOW * distance)
    return np.asarray(beneath | (distance < _TOUCHING))
