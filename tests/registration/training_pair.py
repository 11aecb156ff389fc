"""Two scans of a small furnished room to learn from."""

import numpy as np
from furnished_room import room

from nss_ros.geometry import from_yaw, inverse, transform_points
from nss_ros.registration.learned.training.example import Example

TRUTH = from_yaw(0.4, (0.6, -0.3, 0.0))


def training_pair():
    """Three quarters each of the room, with different noise."""
    source, target = room(1), room(2)
    source = transform_points(inverse(TRUTH), source[source[:, 0] < 1.3]).astype(np.float32)
    return Example(source, target[target[:, 0] > -1.3], TRUTH)


def distant_pair():
    """Two scans that have nothing in common."""
    source = training_pair().source
    return Example(source, source, from_yaw(0, (50.0, 0, 0)))
