"""A good place for a picture of the inside: free at all stages, and with much in sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Site

EYE_HEIGHT = 1.6
"""Above the floor, metres."""

_STEP = 1.0  # between places, metres
_HEADINGS = 16
_FAN = np.radians(np.linspace(-35.0, 35.0, 15))
_FAR = 9.0  # farther surfaces do not make a view better, metres
_NEAREST = 1.0  # that may stand in the way, metres
_FLOOR_TOLERANCE = 0.3


@dataclass(frozen=True, slots=True)
class View:
    """Where to stand and where to look.

    Attributes:
        eye: x, y, z in the map frame, metres.
        heading: degrees from x to y.
    """

    eye: tuple[float, float, float]
    heading: float


def widest_view(site: Site) -> View:
    """The view along the floor that is widest at the stage at which it is narrowest.

    Places lie on a grid of 1 m, have the floor below them at every stage, and nothing within 1 m
    in the field of view. Views that things come into and vanish from are better.

    Args:
        site: of any source.

    Raises:
        InputError: there is no such place.
    """
    extent, eye_height = site.extent, site.floor_height + EYE_HEIGHT
    columns, rows = np.arange(extent.x0, extent.x1, _STEP), np.arange(extent.y0, extent.y1, _STEP)
    grid = np.stack(np.meshgrid(columns + _STEP / 2, rows + _STEP / 2), axis=-1).reshape(-1, 2)
    eyes = np.column_stack((grid, np.full(len(grid), eye_height)))
    headings = np.linspace(0.0, 2 * np.pi, _HEADINGS, endpoint=False, dtype=np.float64)
    ways = np.array([_sight(site, stage, eyes, headings) for stage in range(1, site.stages + 1)])
    change = np.abs(np.diff(ways, axis=0)).mean(axis=-1).sum(axis=0)
    score = ways.mean(axis=-1).min(axis=0) + 0.5 * change
    score[(ways < _NEAREST).any(axis=(0, 3))] = -np.inf
    place, heading = np.unravel_index(int(np.argmax(score)), score.shape)
    if not np.isfinite(score[place, heading]):
        raise InputError(
            f"Area {site.area} has no place from which one can look around at every stage: give "
            "the eye and the heading."
        )
    x, y, z = eyes[place]
    return View((float(x), float(y), float(z)), float(np.degrees(headings[heading])))


def _sight(
    site: Site, stage: int, eyes: NDArray[np.float64], headings: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far one sees, metres: (places, headings, fan); 0 where there is no floor to stand on.

    What leaves the site shows nothing and counts as little as may be.
    """
    scene = Scene(site.stage_mesh(stage).mesh)
    below = scene.cast(eyes, np.broadcast_to((0.0, 0.0, -1.0), eyes.shape)).distances
    stands = np.abs(below - EYE_HEIGHT) < _FLOOR_TOLERANCE
    angles = headings[:, None] + _FAN
    fan = np.stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)), axis=-1).reshape(-1, 3)
    origins = np.repeat(eyes, len(fan), axis=0)
    distances = scene.cast(origins, np.tile(fan, (len(eyes), 1))).distances
    sight = np.where(np.isfinite(distances), np.minimum(distances, _FAR), _NEAREST)
    sight = sight.reshape(len(eyes), len(headings), len(_FAN))
    return np.where(stands[:, None, None], sight, 0.0).astype(np.float64)
