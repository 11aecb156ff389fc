"""Plan of a floor's structure: grid, bands of rooms, corridors, cores and zones of work."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nss_ros.config import SiteConfig
from nss_ros.simulation.procedural.grid import Grid, draw_grid
from nss_ros.simulation.site import Rectangle

FACADE_THICKNESS = 0.3
SLAB_OVERHANG = FACADE_THICKNESS + 0.1
COLUMN_WIDTH = 0.4
CORE_WALL = 0.25
DOOR_HEIGHT = 2.15
LEAST_ROOM = 1.8  # depth of a room behind a core, metres

_TWO_CORRIDORS_FROM = 18.0  # depth of the floor, metres
_LONGEST_SPAN = 8.5  # between column rows, metres
_AREA_PER_CORE = 900.0
_CORE_DEPTH = 6.5
_BAYS_PER_ZONE = 3
SOUTH, MIDDLE, NORTH = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Band:
    """A strip of rooms beside a corridor.

    Attributes:
        y0: its lower edge, plan coordinates.
        y1: its upper edge.
        corridor_y: the edge at its corridor.
        side: SOUTH, MIDDLE or NORTH.
    """

    y0: float
    y1: float
    corridor_y: float
    side: int


@dataclass(frozen=True, slots=True)
class Core:
    """A concrete core; lift, stair and shaft lie side by side along the corridor.

    Attributes:
        area: outer faces of its walls, plan coordinates.
        door_y: the edge at its corridor.
        lift: clear space of the lift shaft, a hole in all slabs.
        stair: clear space of the stair.
        shaft: clear space of the riser shaft, a hole in all slabs.
    """

    area: Rectangle
    door_y: float
    lift: Rectangle
    stair: Rectangle
    shaft: Rectangle

    @property
    def stair_hole(self) -> Rectangle:
        """Where the flight from below comes up."""
        middle = (self.stair.x0 + self.stair.x1) / 2
        inner = (self.stair.y0 + self.stair.y1) / 2
        landing = 1.3 if self.door_y < inner else -1.3
        y = self.door_y + landing
        back = self.stair.y1 if landing > 0 else self.stair.y0
        return Rectangle(self.stair.x0, min(y, back), middle, max(y, back))


@dataclass(frozen=True, slots=True)
class Plan:
    """What a floor is laid out on; plan coordinates, see `grid`.

    Attributes:
        grid: of its bays.
        height: from floor slab to ceiling slab, metres.
        beam_depth: of the beams below the ceiling slab, 0 for a flat slab, metres.
        rows: y of the column rows.
        bands: strips of rooms.
        corridors: (y0, y1) of each corridor.
        cores: one or several.
        zone_groups: per bay, the group of bays it belongs to.
    """

    grid: Grid
    height: float
    beam_depth: float
    rows: tuple[float, ...]
    bands: tuple[Band, ...]
    corridors: tuple[tuple[float, float], ...]
    cores: tuple[Core, ...]
    zone_groups: tuple[int, ...]

    @property
    def below_beams(self) -> float:
        """Height up to which nothing of the structure reaches down, metres."""
        return self.height - max(self.beam_depth, 0.05)

    @property
    def ceiling_height(self) -> float:
        """Of dropped ceilings, metres."""
        return max(min(self.below_beams - 0.4, 2.75), 2.25)

    def zone(self, x: float, side: int) -> int:
        """The zone of work at some x on one side of the floor."""
        return self.zone_groups[int(self.grid.bay_at(x))] * 3 + side

    def zone_order(self) -> np.ndarray:
        """Place of every zone in the order of work, (zones,) in [-1, 1]."""
        groups = np.repeat(np.arange(max(self.zone_groups) + 1), 3)
        return np.asarray(2 * groups / max(groups.max(), 1) - 1, dtype=np.float64)

    def holes(self) -> list[Rectangle]:
        """Where the floor slab has none, and the ceiling slab neither."""
        return [hole for core in self.cores for hole in (core.lift, core.shaft)]


def draw_plan(config: SiteConfig, rng: np.random.Generator) -> Plan:
    """The structure of a floor.

    Raises:
        InputError: the wings run into one another.
    """
    grid = draw_grid(config, rng)
    bands, corridors = _bands(config.depth, rng)
    beam_depth = float(rng.choice([0.0, 0.35, 0.45])) if config.height >= 3.2 else 0.3
    return Plan(
        grid=grid,
        height=config.height,
        beam_depth=beam_depth,
        rows=_rows(config.depth, corridors),
        bands=bands,
        corridors=corridors,
        cores=_cores(grid, bands, rng),
        zone_groups=_zone_groups(grid),
    )


def _bands(
    depth: float, rng: np.random.Generator
) -> tuple[tuple[Band, ...], tuple[tuple[float, float], ...]]:
    width = rng.uniform(1.8, 2.3)
    if depth < _TWO_CORRIDORS_FROM:
        south = (depth - width) / 2 + rng.uniform(-0.04, 0.04) * depth
        north = south + width
        bands = (Band(0.0, south, south, SOUTH), Band(north, depth, north, NORTH))
        return bands, ((south, north),)
    room = float(np.clip(0.28 * depth, 5.2, 8.0)) + rng.uniform(-0.2, 0.2)
    south, north = room, depth - room
    inner_south, inner_north = south + width, north - width
    outer = (Band(0.0, south, south, SOUTH), Band(north, depth, north, NORTH))
    corridors = ((south, inner_south), (inner_north, north))
    if inner_north - inner_south < 10:
        return (*outer, Band(inner_south, inner_north, inner_south, MIDDLE)), corridors
    middle = (inner_south + inner_north) / 2
    inner = (
        Band(inner_south, middle, inner_south, MIDDLE),
        Band(middle, inner_north, inner_north, MIDDLE),
    )
    return (*outer, *inner), corridors


def _rows(depth: float, corridors: tuple[tuple[float, float], ...]) -> tuple[float, ...]:
    """Columns at the facades and in the corridor walls, and between where the span is long."""
    inset = COLUMN_WIDTH / 2 + 0.05
    fixed = [inset, *(y for corridor in corridors for y in corridor), depth - inset]
    rows: list[float] = []
    for low, high in pairwise(fixed):
        count = int(np.ceil((high - low) / _LONGEST_SPAN))
        rows += np.linspace(low, high, count + 1)[:-1].tolist()
    return (*rows, fixed[-1])


def _cores(
    grid: Grid,
    bands: tuple[Band, ...],
    rng: np.random.Generator,
) -> tuple[Core, ...]:
    """Cores in the bays in the middle of equal parts of the floor."""
    candidates = [bay for first, last in grid.runs() for bay in range(first, last + 1)]
    count = max(1, round(grid.length * grid.depth / _AREA_PER_CORE))
    shares = (np.arange(count) + rng.uniform(0.35, 0.65)) / count
    picked = sorted({candidates[int(share * len(candidates))] for share in shares})
    middle = [band for band in bands if band.side == MIDDLE]
    band = middle[0] if middle else bands[-1]
    # The only band between two corridors leaves room behind its cores.
    depth = band.y1 - band.y0
    if len(middle) == 1 and depth > _CORE_DEPTH + LEAST_ROOM:
        depth = _CORE_DEPTH
    return tuple(_core(grid, bay, band, depth) for bay in picked)


def _core(grid: Grid, bay: int, band: Band, depth: float) -> Core:
    x0, x1 = grid.stations[bay], grid.stations[bay + 1]
    y0, y1 = band.y0, band.y0 + depth
    low, high = y0 + CORE_WALL, y1 - CORE_WALL
    edges = x0 + CORE_WALL + np.array([0.0, 0.38, 0.8, 1.0]) * (x1 - x0 - CORE_WALL)
    lift, stair, shaft = (
        Rectangle(float(a), low, float(b) - CORE_WALL, high) for a, b in pairwise(edges)
    )
    lift = Rectangle(lift.x0, low, lift.x1, min(high, low + 2.4))
    return Core(Rectangle(float(x0), y0, float(x1), y1), band.corridor_y, lift, stair, shaft)


def _zone_groups(grid: Grid) -> tuple[int, ...]:
    return tuple(bay // _BAYS_PER_ZONE for bay in range(grid.bays))
