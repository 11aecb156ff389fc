"""Floor plan of a procedural construction floor: grid, core, rooms and partition walls."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nss_ros.config import SiteConfig
from nss_ros.geometry import Transform, from_yaw
from nss_ros.simulation.mesh import Opening
from nss_ros.simulation.site import Rectangle

FACADE_THICKNESS = 0.3
COLUMN_WIDTH = 0.35
BEAM_DEPTH = 0.45
DOOR_HEIGHT = 2.1


@dataclass(frozen=True, slots=True)
class Partition:
    """A dry-lined wall from `start` to `end` and how far it is built at each stage.

    Attributes:
        start: x, y of one end of its axis.
        end: x, y of the other.
        doors: openings along it.
        progress: per stage, 0 nothing, 1 bottom track, 2 studs, 3 one side boarded, 4 closed.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    doors: tuple[Opening, ...]
    progress: tuple[int, ...]

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def pose(self) -> Transform:
        """`T_map_wall`: the wall's frame has x along it from `start` and z up."""
        yaw = np.arctan2(self.end[1] - self.start[1], self.end[0] - self.start[0])
        return from_yaw(float(yaw), (*self.start, 0.0))


@dataclass(frozen=True, slots=True)
class Plan:
    """What stands where; the inner face of the facade starts at (0, 0).

    Attributes:
        width: clear size along x, metres.
        depth: clear size along y, metres.
        height: from floor slab to ceiling slab, metres.
        columns_x: x of the column rows.
        columns_y: y of the column rows.
        core: concrete core with lift shaft and stairs.
        corridor: between the southern and the northern rooms.
        rooms: areas in which things are put, the corridor not among them.
        partitions: dry-lined walls.
    """

    width: float
    depth: float
    height: float
    columns_x: tuple[float, ...]
    columns_y: tuple[float, ...]
    core: Rectangle
    corridor: Rectangle
    rooms: tuple[Rectangle, ...]
    partitions: tuple[Partition, ...]


def draw_plan(config: SiteConfig, rng: np.random.Generator) -> Plan:
    """A random plan: a corridor beside a core, rooms of unequal size on both sides."""
    width, depth = config.width, config.depth
    south = 0.4 * depth + rng.uniform(-0.3, 0.3)
    north = south + rng.uniform(1.7, 2.0)
    core_x = 0.4 * width + rng.uniform(-0.6, 0.6)
    core = Rectangle(core_x, north, core_x + 3.4, min(north + 3.3, depth - 1.4))
    splits = width * (np.array([0.24, 0.47, 0.73]) + rng.uniform(-0.04, 0.04, 3))
    west = 0.2 * width + rng.uniform(-0.3, 0.3)
    east = 0.79 * width + rng.uniform(-0.4, 0.4)
    south_edges = [0.0, *splits.tolist(), width]
    rooms = [Rectangle(a, 0.0, b, south) for a, b in pairwise(south_edges)]
    rooms += [
        Rectangle(0.0, north, west, depth),
        Rectangle(west + 0.8, north, core.x0, depth),
        Rectangle(core.x1, north, east, depth),
        Rectangle(east, north, width, depth),
    ]
    walls = [((a, south), (b, south), 1) for a, b in pairwise(south_edges)]
    walls += [((x, 0.0), (x, south), index % 2) for index, x in enumerate(splits.tolist())]
    walls += [
        ((0.0, north), (west, north), 1),
        ((west, north), (core.x0, north), 1),
        ((west, north), (west + 0.8, depth), 0),
        ((east, north), (east, depth), 1),
        ((east, north), (width, north), 1),
    ]
    return Plan(
        width=width,
        depth=depth,
        height=config.height,
        columns_x=_rows(width),
        columns_y=_snapped(_rows(depth), north),
        core=core,
        corridor=Rectangle(0.0, south, width, north),
        rooms=tuple(rooms),
        partitions=tuple(
            _partition(start, end, doors, config.stages, rng) for start, end, doors in walls
        ),
    )


def _rows(size: float) -> tuple[float, ...]:
    count = max(3, round(size / 5.2) + 1)
    inset = COLUMN_WIDTH / 2
    return tuple(np.linspace(inset, size - inset, count).tolist())


def _snapped(rows: tuple[float, ...], position: float) -> tuple[float, ...]:
    """The inner row nearest to a position moved there, so that columns stand in a wall."""
    inner = rows[1:-1]
    nearest = min(inner, key=lambda row: abs(row - position))
    return tuple(position if row == nearest else row for row in rows)


def _partition(
    start: tuple[float, float],
    end: tuple[float, float],
    doors: int,
    stages: int,
    rng: np.random.Generator,
) -> Partition:
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    openings = []
    if doors:
        door_width = float(rng.choice([0.95, 0.95, 1.1, 1.6]))
        position = rng.uniform(0.5, max(0.55, length - door_width - 0.5))
        openings.append(Opening(position, position + door_width, 0.0, DOOR_HEIGHT))
    return Partition(start, end, tuple(openings), _progress(rng)[:stages])


def _progress(rng: np.random.Generator) -> tuple[int, ...]:
    """Zones are not in step: a wall may be closed where the next one is a chalk line."""
    first = int(rng.choice([0, 1, 2, 3], p=[0.3, 0.2, 0.4, 0.1]))
    second = max(first, int(rng.choice([2, 3, 4], p=[0.3, 0.4, 0.3])))
    third = max(second, int(rng.choice([3, 4], p=[0.15, 0.85])))
    return first, second, third
