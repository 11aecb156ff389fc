"""The grid of a floor: bays in a row along its wings, straight, bent or turning a corner.

All that is built is laid out in *plan coordinates*, as if the floor were one straight strip:
x along the wings, y from one long facade to the other. The grid maps them into the map frame,
bay by bay. A straight wing is mapped as it is; a curved wing is a row of bays each of which is
a little wider on its outer side; a corner between two wings is a fan of bays that meet at the
inner corner. Within a bay lines stay straight, so walls stay planes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.ops import unary_union

from nss_ros.config import SiteConfig
from nss_ros.errors import InputError
from nss_ros.geometry import Transform, from_yaw
from nss_ros.simulation.mesh import Mesh

_CORNER_BAY = 7.5  # along the outer facade of a corner, metres


@dataclass(frozen=True, slots=True)
class Grid:
    """Bays between grid lines.

    Attributes:
        stations: (n + 1,) x of the grid lines in plan coordinates, metres.
        near: (n + 1, 2) where they meet the facade at y = 0, map frame, metres.
        far: (n + 1, 2) where they meet the facade at y = depth.
        depth: metres.
        corners: bays that turn a corner; nothing but the outer half of them can be used.
    """

    stations: NDArray[np.float64]
    near: NDArray[np.float64]
    far: NDArray[np.float64]
    depth: float
    corners: frozenset[int]

    @property
    def bays(self) -> int:
        """Their number."""
        return len(self.stations) - 1

    @property
    def length(self) -> float:
        """Of the whole strip in plan coordinates, metres."""
        return float(self.stations[-1])

    def bay_at(self, x: NDArray[np.float64] | float) -> NDArray[np.int64]:
        """The bay in which each x lies; the first or last for what lies beyond the ends."""
        index = np.searchsorted(self.stations, x, side="right") - 1
        return np.asarray(np.clip(index, 0, self.bays - 1))

    def length_at(self, bay: int, y: float) -> float:
        """True length of a bay along x at some y, metres."""
        lines = self.near + (self.far - self.near) * (y / self.depth)
        return float(np.linalg.norm(lines[bay + 1] - lines[bay]))

    def runs(self) -> Iterator[tuple[int, int]]:
        """First and last bay (included) of every row of bays between corners and ends."""
        first = 0
        for bay in range(self.bays + 1):
            if bay == self.bays or bay in self.corners:
                if first < bay:
                    yield first, bay - 1
                first = bay + 1

    def places(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Plan coordinates (n, 2) in the map frame, (n, 2)."""
        bay = self.bay_at(xy[:, 0])
        along = (xy[:, 0] - self.stations[bay]) / np.diff(self.stations)[bay]
        across = xy[:, 1:] / self.depth
        start = self.near[bay] + (self.far[bay] - self.near[bay]) * across
        end = self.near[bay + 1] + (self.far[bay + 1] - self.near[bay + 1]) * across
        return np.asarray(start + (end - start) * along[:, None])

    def built(self, mesh: Mesh) -> Mesh:
        """A mesh in plan coordinates as it is built, map frame."""
        vertices = mesh.vertices.copy()
        vertices[:, :2] = self.places(mesh.vertices[:, :2])
        return Mesh(vertices, mesh.triangles)

    def frame(self, x: float, y: float) -> Transform:
        """`T_map_place` for a thing at (x, y) that keeps its shape; its x axis along the bay."""
        bay = int(self.bay_at(x))
        chord = (self.near + self.far)[bay + 1] - (self.near + self.far)[bay]
        place = self.places(np.array([[x, y]]))[0]
        return from_yaw(math.atan2(chord[1], chord[0]), (*place, 0.0))

    def outline(self) -> list[Polygon]:
        """The bays in the map frame."""
        # Rounded, so that the points in which a corner's lines meet are one.
        near, far = np.round(self.near, 6), np.round(self.far, 6)
        return [Polygon([near[i], near[i + 1], far[i + 1], far[i]]) for i in range(self.bays)]


def draw_grid(config: SiteConfig, rng: np.random.Generator) -> Grid:
    """The grid of a floor, the first wing along x of the map; bays of 6 to 8 m.

    Raises:
        InputError: the wings run into one another.
    """
    wish = rng.uniform(6.2, 7.6)
    steps = _row(config.width, 0.0, wish)
    corners: set[int] = set()
    for wing in config.wings:
        if wing.turn:
            fan = _corner(math.radians(wing.turn), config.depth)
            corners |= set(range(len(steps), len(steps) + len(fan)))
            steps += fan
        steps += _row(wing.length, math.radians(wing.arc), wish)
    grid = _walk(steps, config.depth, frozenset(corners))
    outline = grid.outline()
    if unary_union(outline).area < 0.999 * sum(bay.area for bay in outline):
        raise InputError(
            "The wings of this floor run into one another: make them longer or turn them less."
        )
    return grid


def _row(length: float, arc: float, wish: float) -> list[tuple[float, float]]:
    """Length and turn of every bay of a wing."""
    count = max(2, round(length / wish))
    return [(length / count, arc / count)] * count


def _corner(turn: float, depth: float) -> list[tuple[float, float]]:
    count = max(1, round(abs(turn) * depth / _CORNER_BAY))
    step = turn / count
    return [(depth * abs(math.sin(step / 2)), step)] * count


def _walk(steps: list[tuple[float, float]], depth: float, corners: frozenset[int]) -> Grid:
    """The grid lines met when walking along the middle of the floor."""
    middle, heading = np.array([0.0, depth / 2]), 0.0
    middles, headings = [middle], [heading]
    for length, turn in steps:
        chord = heading + turn / 2
        middle = middle + length * np.array([math.cos(chord), math.sin(chord)])
        heading += turn
        middles.append(middle)
        headings.append(heading)
    sideways = np.stack((-np.sin(headings), np.cos(headings)), axis=1) * (depth / 2)
    stations = np.concatenate(([0.0], np.cumsum([length for length, _ in steps])))
    return Grid(stations, middles - sideways, middles + sideways, depth, corners)
