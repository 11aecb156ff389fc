"""A 2-D occupancy map of one stage: where obstacles stand, and where one can walk and stand."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nss_ros.config import ViewpointConfig
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Rectangle, Site, StageMesh

_DOOR = re.compile(r"\b(ifc)?door", re.IGNORECASE)
_UNEVEN = 0.05
"""Steps higher than this between neighbouring cells are no place for a tripod, metres."""
_CHUNK = 2_000_000
"""Samples of surfaces at a time."""


@dataclass(frozen=True, slots=True)
class OccupancyMap:
    """A 2-D map of one stage; cell (i, j) has its centre at `origin + (i + 0.5, j + 0.5) * cell`.

    Attributes:
        origin: (2,) x, y of the corner of cell (0, 0), metres, map frame.
        cell_size: metres.
        occupied: (nx, ny) something stands between the two heights.
        passable: (nx, ny) floor on which nothing stands but a door, which can be opened.
        surface: (nx, ny) z of the floor, metres, map frame; NaN where there is none.
    """

    origin: NDArray[np.float64]
    cell_size: float
    occupied: NDArray[np.bool_]
    passable: NDArray[np.bool_]
    surface: NDArray[np.float64]

    def standable(self) -> NDArray[np.bool_]:
        """Cells (nx, ny) that are free and as high as their neighbours."""
        floor = np.isfinite(self.surface)
        low = ndimage.minimum_filter(np.where(floor, self.surface, np.inf), 3, mode="nearest")
        high = ndimage.maximum_filter(np.where(floor, self.surface, -np.inf), 3, mode="nearest")
        return np.asarray(floor & ~self.occupied & (high - low <= _UNEVEN))

    def clearance(self) -> NDArray[np.float64]:
        """Distance of every cell (nx, ny) from the nearest that is not standable, metres."""
        return _distance(self.standable(), self.cell_size)

    def reachable(self, passage: float, min_region: float) -> list[NDArray[np.bool_]]:
        """The connected regions of floor that one can walk on, each (nx, ny), largest first.

        Args:
            passage: distance from obstacles that one keeps, metres.
            min_region: least area, as a share of that of the largest region.
        """
        regions = self.regions(passage)
        largest = next(regions, None)
        if largest is None:
            return []
        least = min_region * np.count_nonzero(largest)
        others = regions if min_region < 1 else iter(())
        return [largest, *takewhile(lambda each: np.count_nonzero(each) >= least, others)]

    def regions(self, passage: float) -> Iterator[NDArray[np.bool_]]:
        """All connected regions of floor that one can walk on, each (nx, ny), largest first.

        Args:
            passage: distance from obstacles that one keeps, metres.
        """
        labels, count = ndimage.label(_distance(self.passable, self.cell_size) >= passage)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        for index in np.argsort(-sizes, kind="stable").tolist():
            yield labels == index + 1

    def centres(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """x, y of cells (n, 2), metres."""
        return np.asarray(self.origin + (cells + 0.5) * self.cell_size)

    def cells_at(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Cells (..., 2) in which points (..., 2) lie, clipped to the map."""
        cells = np.floor((points - self.origin) / self.cell_size).astype(np.int64)
        return np.clip(cells, 0, np.array(self.occupied.shape) - 1)


def door_triangles(site: Site, stage: StageMesh) -> NDArray[np.bool_]:
    """Which triangles (m,) of a stage belong to doors, by the kind of their element."""
    doors = np.array([bool(_DOOR.search(e.kind)) for e in site.elements], dtype=bool)
    return np.asarray(doors[stage.elements])


def occupancy_map(
    scene: Scene,
    of_door: NDArray[np.bool_],
    area: Rectangle,
    floor_height: float,
    config: ViewpointConfig,
) -> OccupancyMap:
    """The map of a stage inside an area.

    Surfaces between the two heights are sampled so densely that no cell they pass through is
    missed but at a corner; the floor is what a ray down from the lower height hits.

    Args:
        scene: the site at that stage.
        of_door: (m,) which triangles are doors, obstacles that open.
        area: what the map covers.
        floor_height: z of the floor, metres.
        config: cell size, heights above the floor, and tolerance of the floor height.
    """
    cell = config.cell_size
    shape = (math.ceil((area.x1 - area.x0) / cell), math.ceil((area.y1 - area.y0) / cell))
    heights = (floor_height + config.min_height, floor_height + config.max_height)
    corners = scene.mesh.vertices[scene.mesh.triangles]
    blocked = _crossed_cells(corners[~of_door], heights, area, shape, cell)
    closed = _crossed_cells(corners[of_door], heights, area, shape, cell)
    surface = _floor_surface(scene, area, shape, floor_height, config)
    return OccupancyMap(
        np.array([area.x0, area.y0]),
        cell,
        blocked | closed,
        np.isfinite(surface) & ~blocked,
        surface,
    )


def surface_samples(corners: NDArray[np.floating], spacing: float) -> Iterator[NDArray[np.float64]]:
    """Points all over triangles, in rows along the longest edge of each.

    Args:
        corners: (m, 3, 3) triangles, metres.
        spacing: most distance between rows, and between points of a row, metres.

    Yields:
        (n, 3) points of some triangles.
    """
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    first = np.argmax(edges, axis=1)
    turned = (first[:, None] + np.arange(3)) % 3
    a, b, c = (corners[np.arange(len(corners)), turned[:, k]] for k in range(3))
    length = edges.max(axis=1, initial=0)
    doubled_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    height = np.divide(doubled_area, length, out=np.zeros_like(length), where=length > 0)
    rows = np.ceil(height / spacing).astype(np.int64) + 1
    total = np.cumsum(rows * (length / spacing + 2))
    bounds = np.searchsorted(total, np.arange(_CHUNK, total.max(initial=0), _CHUNK))
    for part in np.split(np.arange(len(corners)), bounds):
        owner = np.repeat(part, rows[part])
        v = _fractions(rows[part])
        points = np.ceil(length[owner] * (1 - v) / spacing).astype(np.int64) + 1
        u = _fractions(points)[:, None]
        starts = a[owner] + (c - a)[owner] * v[:, None]
        spans = (b - a)[owner] * (1 - v)[:, None]
        yield np.repeat(starts, points, axis=0) + np.repeat(spans, points, axis=0) * u


def _fractions(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """For every count n the n numbers from 0 to 1, evenly spaced; 0 for n = 1."""
    starts = np.cumsum(counts) - counts
    index = np.arange(counts.sum()) - np.repeat(starts, counts)
    return np.asarray(index / np.repeat(np.maximum(counts - 1, 1), counts))


def _crossed_cells(
    corners: NDArray[np.float64],
    heights: tuple[float, float],
    area: Rectangle,
    shape: tuple[int, int],
    cell: float,
) -> NDArray[np.bool_]:
    low, high = corners.min(axis=1), corners.max(axis=1)
    inside = (high >= (area.x0, area.y0, heights[0])) & (low <= (area.x1, area.y1, heights[1]))
    crossed = np.zeros(shape, dtype=bool)
    for points in surface_samples(corners[inside.all(axis=1)], cell / 2):
        between = points[(points[:, 2] >= heights[0]) & (points[:, 2] <= heights[1])]
        cells = np.floor((between[:, :2] - (area.x0, area.y0)) / cell).astype(np.int64)
        cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
        crossed[cells[:, 0], cells[:, 1]] = True
    return crossed


def _floor_surface(
    scene: Scene,
    area: Rectangle,
    shape: tuple[int, int],
    floor_height: float,
    config: ViewpointConfig,
) -> NDArray[np.float64]:
    """Height z of the floor (nx, ny), NaN where there is none near the floor height."""
    cells = np.indices(shape).reshape(2, -1).T
    origins = np.empty((len(cells), 3))
    origins[:, :2] = (area.x0, area.y0) + (cells + 0.5) * config.cell_size
    origins[:, 2] = floor_height + config.min_height
    down = np.zeros((len(cells), 3))
    down[:, 2] = -1
    drop = scene.cast(origins, down).distances.reshape(shape).astype(np.float64)
    # The median closes joints between slabs and swallows what is one cell wide.
    below = ndimage.median_filter(drop, 3, mode="nearest") - config.min_height
    surface = floor_height - below
    return np.where(np.abs(below) <= config.floor_tolerance + 1e-4, surface, np.nan)


def _distance(free: NDArray[np.bool_], cell: float) -> NDArray[np.float64]:
    """Distance of every cell from the nearest that is not free; the map's border is not."""
    padded = ndimage.distance_transform_edt(np.pad(free, 1))
    return np.asarray(padded[1:-1, 1:-1] * cell)
