"""Where the tripod is put: free, reachable floor, in sight of an earlier spot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nss_ros.config import ViewpointConfig
from nss_ros.errors import InputError
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Rectangle

_FLOOR_TOLERANCE = 0.05
_CANDIDATES = 80
_SIGHT_DIRECTIONS = 120


@dataclass(frozen=True, slots=True)
class OccupancyMap:
    """A 2-D map of one stage; cell (i, j) has its centre at `origin + (i + 0.5, j + 0.5) * cell`.

    Attributes:
        origin: (2,) x, y of the corner of cell (0, 0), metres, map frame.
        cell_size: metres.
        occupied: (nx, ny) something stands between the two heights.
        floor: (nx, ny) bare floor: no hole, nothing lying on it.
    """

    origin: NDArray[np.float64]
    cell_size: float
    occupied: NDArray[np.bool_]
    floor: NDArray[np.bool_]

    def clearance(self) -> NDArray[np.float64]:
        """Distance of every cell from the nearest obstacle or from floor that is not bare."""
        distance = ndimage.distance_transform_edt(self.floor & ~self.occupied)
        return np.asarray(distance * self.cell_size)

    def centres(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """x, y of cells (n, 2), metres."""
        return np.asarray(self.origin + (cells + 0.5) * self.cell_size)

    def cells_at(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Cells (..., 2) in which points (..., 2) lie, clipped to the map."""
        cells = np.floor((points - self.origin) / self.cell_size).astype(np.int64)
        return np.clip(cells, 0, np.array(self.occupied.shape) - 1)


def occupancy_map(scene: Scene, area: Rectangle, config: ViewpointConfig) -> OccupancyMap:
    """The map of a stage inside an area.

    Args:
        scene: the site at that stage, map frame, floor at z = 0.
        area: what the map covers.
        config: cell size and heights.
    """
    cell = config.cell_size
    origin = np.array([area.x0, area.y0])
    shape = (math.ceil((area.x1 - area.x0) / cell), math.ceil((area.y1 - area.y0) / cell))
    cells = np.array(list(np.ndindex(shape)))
    heights = np.arange(config.min_height, config.max_height + cell / 2, cell)
    columns = np.empty((len(heights), len(cells), 3))
    columns[..., :2] = origin + (cells + 0.5) * cell
    columns[..., 2] = heights[:, None]
    nearest = scene.distance(columns.reshape(-1, 3)).reshape(len(heights), -1).min(axis=0)
    # Half the diagonal of a cell: whatever passes through it is nearer to its centre.
    occupied = nearest < cell * math.sqrt(0.5)
    drop, _ = scene.cast(columns[0], np.tile([0.0, 0.0, -1.0], (len(cells), 1)))
    floor = np.abs(drop - config.min_height) < _FLOOR_TOLERANCE
    return OccupancyMap(origin, cell, occupied.reshape(shape), floor.reshape(shape))


def choose_viewpoints(
    occupancy: OccupancyMap, config: ViewpointConfig, view_range: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Spots, (n, 2) metres, n at most `spots_per_stage`.

    Of a random sample that favours distance from obstacles, each spot is the one that sees
    most floor that none has seen yet; all but the first are in sight of an earlier one.

    Raises:
        InputError: there is no free floor to stand on.
    """
    clearance = occupancy.clearance()
    reachable = _largest_region(clearance >= config.passage)
    standing = np.argwhere(reachable & (clearance >= config.min_clearance))
    if len(standing) == 0:
        raise InputError(
            f"No free floor with {config.min_clearance} m of clearance: lower "
            "simulation.viewpoints.min_clearance."
        )
    weights = np.minimum(clearance[tuple(standing.T)], 1.0)
    places = occupancy.centres(standing)
    seen = np.zeros_like(reachable)
    spots: list[NDArray[np.float64]] = []
    while len(spots) < config.spots_per_stage:
        candidates = _candidates(occupancy, places, weights, spots, config, rng)
        if not candidates:
            break
        views = [_visible(occupancy, candidate, view_range) for candidate in candidates]
        gains = [np.count_nonzero(view & reachable & ~seen) for view in views]
        best = int(np.argmax(gains))
        seen |= views[best]
        spots.append(candidates[best])
    return np.array(spots)


def _candidates(
    occupancy: OccupancyMap,
    places: NDArray[np.float64],
    weights: NDArray[np.float64],
    spots: list[NDArray[np.float64]],
    config: ViewpointConfig,
    rng: np.random.Generator,
) -> list[NDArray[np.float64]]:
    """A weighted sample of the places to which one would carry the tripod next."""
    for longest in (config.usual_spacing, config.max_spacing):
        chance = weights * _at_distance(places, spots, config.min_spacing, longest)
        count = min(_CANDIDATES, int(np.count_nonzero(chance)))
        if count == 0:
            continue
        drawn = places[rng.choice(len(places), count, replace=False, p=chance / chance.sum())]
        if not spots:
            return list(drawn)
        linked = [place for place in drawn if _linked(occupancy, place, spots, longest)]
        if linked:
            return linked
    return []


def _largest_region(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    labels, count = ndimage.label(free)
    if count == 0:
        return np.zeros_like(free)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(labels == np.argmax(sizes))


def _at_distance(
    places: NDArray[np.float64],
    spots: list[NDArray[np.float64]],
    shortest: float,
    longest: float,
) -> NDArray[np.bool_]:
    """Which places have their nearest spot between two distances."""
    if not spots:
        return np.ones(len(places), dtype=bool)
    nearest = np.min([np.linalg.norm(places - spot, axis=1) for spot in spots], axis=0)
    return np.asarray((nearest >= shortest) & (nearest <= longest))


def _linked(
    occupancy: OccupancyMap,
    place: NDArray[np.float64],
    spots: list[NDArray[np.float64]],
    max_spacing: float,
) -> bool:
    return any(
        np.linalg.norm(place - spot) <= max_spacing and in_sight(occupancy, place, spot)
        for spot in spots
    )


def in_sight(occupancy: OccupancyMap, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    """Whether nothing stands on the line between two places."""
    steps = max(2, int(np.ceil(np.linalg.norm(end - start) / occupancy.cell_size * 2)))
    line = start + np.linspace(0.0, 1.0, steps)[:, None] * (end - start)
    return not occupancy.occupied[tuple(occupancy.cells_at(line).T)].any()


def _visible(
    occupancy: OccupancyMap, place: NDArray[np.float64], view_range: float
) -> NDArray[np.bool_]:
    """Cells that are seen from a place, by marching along rays until something stands there."""
    angles = np.arange(_SIGHT_DIRECTIONS) * (2 * np.pi / _SIGHT_DIRECTIONS)
    steps = np.arange(0.0, view_range, occupancy.cell_size)
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    cells = occupancy.cells_at(place + directions[:, None] * steps[None, :, None])
    blocked = occupancy.occupied[cells[..., 0], cells[..., 1]]
    open_cells = cells[np.cumsum(blocked, axis=1) == 0]
    visible = np.zeros_like(occupancy.occupied)
    visible[open_cells[:, 0], open_cells[:, 1]] = True
    return visible
