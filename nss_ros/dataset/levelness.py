"""Whether a fragment looks like a scan of a levelled tripod, told by what should be level in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nss_ros.dataset.challenge_folder import read_fragment
from nss_ros.fragment import FragmentId, Points
from nss_ros.standpoint import standpoint
from nss_ros.upright import level_surfaces

# Least share of the points that lies on a floor below the sensor, which stands at least this high
# above it, metres.
_LEAST_FLOOR, _FLOOR_BELOW = 0.03, 0.5
# A robot's scanner may be tilted so; registration sets it upright.
_MOST_TILT = np.radians(5.0)
_LOOKED_AT, _MOST_OF_THEM = 24, 0.8
# Axes that may be vertical instead of z, by what makes of them a frame in which z is.
_FEW = 3
_AXES = {"y": ((0, 2, 1), (1, -1, 1)), "x": ((2, 1, 0), (-1, 1, 1))}


def looks_levelled(points: Points) -> bool:
    """Whether z points up, within about five degrees, and the scanner stood above a floor.

    A levelled scan has a floor below its sensor, and level surfaces share a direction. In a frame
    turned at random hardly any surface is that close to level.

    Args:
        points: (n, 3), metres, sensor frame, or one whose origin is elsewhere.
    """
    surfaces = level_surfaces(points)
    if surfaces is None or surfaces.tilt >= _MOST_TILT:
        return False
    floor = surfaces.points[:, 2] < standpoint(points)[2] - _FLOOR_BELOW
    return bool(floor.mean() * surfaces.share > _LEAST_FLOOR)


def files_look_levelled(files: Sequence[tuple[FragmentId, Path]]) -> bool:
    """Whether nearly all of some of the fragments of PLY files look levelled.

    Raises:
        FormatError: a file is not valid, or holds no finite point.
    """
    some = files[:: max(1, -(-len(files) // _LOOKED_AT))]
    levelled = [looks_levelled(read_fragment(id_, file, True)[0].points) for id_, file in some]
    return len(levelled) > 0 and float(np.mean(levelled)) >= _MOST_OF_THEM


def other_vertical_axis(files: Sequence[tuple[FragmentId, Path]]) -> str | None:
    """The axis along which fragments look levelled that do not along z: "x" or "y"; else None.

    It need not be vertical: the walls of a corridor may be taken for its floor and ceiling.

    Args:
        files: PLY files of the fragments; a few are looked at.

    Raises:
        FormatError: a file is not valid, or holds no finite point.
    """
    some = files[:: max(1, -(-len(files) // _FEW))]
    clouds = [read_fragment(id_, file, True)[0].points for id_, file in some]
    for name, (columns, signs) in _AXES.items():
        turned = (cloud[:, columns] * np.array(signs, np.float32) for cloud in clouds)
        if clouds and all(map(looks_levelled, turned)):
            return name
    return None
