"""Layout of a floor's rooms: repeated along the corridors, mirrored from one to the next."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from nss_ros.config import SiteConfig
from nss_ros.geometry import Transform, from_yaw
from nss_ros.simulation.mesh import Opening
from nss_ros.simulation.procedural.plan import DOOR_HEIGHT, LEAST_ROOM, MIDDLE, Band, Plan
from nss_ros.simulation.site import Rectangle

_SIDES = ("south", "middle", "north")
_CELL_WIDTH = 3.4
_WET_DEPTH = 2.3  # of hall and bathroom in flats and wards, metres
_BATH_WIDTH = 1.6
_DOOR_WIDTH = 0.95
_DOOR_INSET = 0.4  # from the nearer end of the wall, metres
_CROSS_CORRIDOR = 1.9


class Construction(Enum):
    """What a wall is made of."""

    STUD = "stud"
    BLOCK = "block"
    GLASS = "glass"


class RoomKind(Enum):
    """What a room is for."""

    CELL = "office"
    OPEN = "open-plan office"
    MEETING = "meeting room"
    SERVICE = "service room"
    LIVING = "living room"
    BEDROOM = "bedroom"
    BATH = "bathroom"
    HALL = "hall"
    WARD = "ward"
    LAB = "laboratory"
    CORRIDOR = "corridor"
    LOBBY = "lobby"


@dataclass(frozen=True, slots=True)
class Wall:
    """A partition from `start` to `end`, along x or along y; plan coordinates.

    Attributes:
        name: for people.
        start: x, y of one end of its axis.
        end: x, y of the other.
        zone: in whose programme it is built.
        doors: openings along it.
        construction: what it is made of.
        swing: to which side its doors open, 1 to the left of the way from start to end, -1 to
            the right.
    """

    name: str
    start: tuple[float, float]
    end: tuple[float, float]
    zone: int
    doors: tuple[Opening, ...] = ()
    construction: Construction = Construction.STUD
    swing: int = 1

    @property
    def length(self) -> float:
        """Metres."""
        return abs(self.end[0] - self.start[0]) + abs(self.end[1] - self.start[1])

    @property
    def pose(self) -> Transform:
        """`T_plan_wall`: the wall's frame has x along it from `start` and z up."""
        yaw = 0.0 if self.start[1] == self.end[1] else np.pi / 2
        return from_yaw(yaw, (*self.start, 0.0))


@dataclass(frozen=True, slots=True)
class Room:
    """A room, or a part of the floor in which things are put; plan coordinates.

    Attributes:
        name: for people.
        kind: what it is for.
        area: between the axes of its walls.
        zone: in whose programme it is.
        corridor_y: its edge nearest to the corridor.
        mirrored: furnished the other way round along x.
    """

    name: str
    kind: RoomKind
    area: Rectangle
    zone: int
    corridor_y: float
    mirrored: bool = False


@dataclass(slots=True)
class Layout:
    """All rooms and partitions of a floor."""

    rooms: list[Room] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)


def draw_layout(plan: Plan, config: SiteConfig, rng: np.random.Generator) -> Layout:
    """Rooms on the bands, between cores, corners and the ends of the floor."""
    drawing = _Drawing(plan, config, rng)
    for first, last in plan.grid.runs():
        for band in plan.bands:
            drawing.fill(band, first, last)
        for index, (y0, y1) in enumerate(plan.corridors):
            drawing.corridor(index, y0, y1, first, last)
    for core in plan.cores:
        drawing.behind(core.area)
    for corner in sorted(plan.grid.corners):
        drawing.lobby(corner)
    return drawing.layout


# Kinds of a row of rooms and how often each is drawn, by use; the middle of a deep floor apart.
_ROWS: dict[str, dict[str, float]] = {
    "office": {"cells": 0.5, "open": 0.3, "meeting": 0.1, "service": 0.1},
    "residential": {"flats": 0.88, "service": 0.12},
    "hospital": {"wards": 0.6, "cells": 0.25, "service": 0.15},
    "laboratory": {"labs": 0.5, "cells": 0.3, "open": 0.1, "service": 0.1},
}
_MIDDLE_ROWS = {"service": 0.35, "meeting": 0.35, "open": 0.3}
_SINGLE = {"meeting", "service"}  # rows of one module


class _Drawing:
    """A layout on its way."""

    def __init__(self, plan: Plan, config: SiteConfig, rng: np.random.Generator) -> None:
        self.layout = Layout()
        self._plan = plan
        self._config = config
        self._rng = rng
        self._block = Construction.BLOCK if config.use == "residential" else Construction.STUD

    def fill(self, band: Band, first: int, last: int) -> None:
        """Rooms along one band from a bay to a bay."""
        stations = self._plan.grid.stations
        cores = [c.area for c in self._plan.cores if c.area.y0 < band.y1 and c.area.y1 > band.y0]
        modules = [
            (float(stations[bay]), float(stations[bay + 1])) for bay in range(first, last + 1)
        ]
        free = [m for m in modules if not any(c.x0 < m[1] and c.x1 > m[0] for c in cores)]
        # Beside all cores, so that the passages of two bands back to back meet.
        clear = [m for m in free if not any(c.area.x0 == m[0] for c in self._plan.cores)]
        if band.side == MIDDLE and clear:
            free[free.index(clear[0])] = self._cross_corridor(band, *clear[0])
        self._rows(band, free)
        for x in (modules[0][0], modules[-1][1]):
            if 0 < x < self._plan.grid.length and not any(x in (c.x0, c.x1) for c in cores):
                self._cross_wall(x, band.y0, band.y1, self._plan.zone(x, band.side), band.side)
        if band.side == MIDDLE and band.y0 > 0 and self._back_to_back(band):
            for x0, x1 in free:
                # Not across the passage, which lies where the modules of both bands begin.
                self._wall((x0, band.y0), (x1, band.y0), self._plan.zone(x0, MIDDLE), MIDDLE)

    def _cross_corridor(self, band: Band, x0: float, x1: float) -> tuple[float, float]:
        """A passage from corridor to corridor; what is left of the module."""
        edge = x0 + _CROSS_CORRIDOR
        zone = self._plan.zone(edge, MIDDLE)
        area = Rectangle(x0, band.y0, edge, band.y1)
        name = f"cross corridor {len(self.layout.rooms) + 1}"
        self.layout.rooms.append(Room(name, RoomKind.LOBBY, area, zone, band.corridor_y))
        if x0 > 0 and not any(core.area.x1 == x0 for core in self._plan.cores):
            self._cross_wall(x0, band.y0, band.y1, zone, MIDDLE)
        self._cross_wall(edge, band.y0, band.y1, zone, MIDDLE)
        return edge, x1

    def behind(self, core: Rectangle) -> None:
        """A service room between a core and the other corridor of a deep floor."""
        if sum(band.side == MIDDLE for band in self._plan.bands) != 1:
            return
        end = self._plan.corridors[1][0]
        if end - core.y1 < LEAST_ROOM:
            return
        band = Band(core.y1, end, end, MIDDLE)
        self._rows(band, [(core.x0, core.x1)], "service")
        zone = self._plan.zone(core.x0 + 0.1, MIDDLE)
        for x in (core.x0, core.x1):
            if not self._has_wall_at(x, band):
                self._cross_wall(x, band.y0, band.y1, zone, MIDDLE)

    def corridor(self, index: int, y0: float, y1: float, first: int, last: int) -> None:
        """The corridor of a run, bay by bay."""
        stations = self._plan.grid.stations
        for bay in range(first, last + 1):
            area = Rectangle(float(stations[bay]), y0, float(stations[bay + 1]), y1)
            zone = self._plan.zone(area.x0 + 0.1, MIDDLE)
            name = f"corridor {index + 1} bay {bay + 1}"
            self.layout.rooms.append(Room(name, RoomKind.CORRIDOR, area, zone, y0))

    def lobby(self, bay: int) -> None:
        """The usable part of a corner."""
        grid = self._plan.grid
        x0, x1 = float(grid.stations[bay]), float(grid.stations[bay + 1])
        inner_is_far = np.allclose(grid.far[bay], grid.far[bay + 1])
        y0, y1 = (0.0, grid.depth * 0.55) if inner_is_far else (grid.depth * 0.45, grid.depth)
        zone = self._plan.zone((x0 + x1) / 2, MIDDLE)
        inset = 0.15 * (x1 - x0)
        area = Rectangle(x0 + inset, y0, x1 - inset, y1)
        name = f"lobby bay {bay + 1}"
        self.layout.rooms.append(Room(name, RoomKind.LOBBY, area, zone, y1 if y0 == 0.0 else y0))

    def _back_to_back(self, band: Band) -> bool:
        return any(other.y1 == band.y0 and other.side == MIDDLE for other in self._plan.bands)

    def _has_wall_at(self, x: float, band: Band) -> bool:
        return any(
            wall.start[0] == x == wall.end[0] and wall.start[1] < band.y1 and wall.end[1] > band.y0
            for wall in self.layout.walls
        )

    def _rows(self, band: Band, modules: list[tuple[float, float]], only: str = "") -> None:
        """Rows of rooms, each of one kind over a few modules."""
        odds = _MIDDLE_ROWS if band.side == MIDDLE else _ROWS[self._config.use]
        left, kind = 0, only
        before: tuple[float, str] | None = None
        for x0, x1 in modules:
            if not only and left == 0:
                kind = str(self._rng.choice(list(odds), p=list(odds.values())))
                left = 1 if kind in _SINGLE else int(self._rng.integers(2, 5))
            left -= 1
            joined = before is not None and before[0] == x0
            open_on = joined and before is not None and before[1] == kind == "open"
            # A module after a core has the core's wall on its left.
            if x0 > 0 and joined and not open_on:
                zone = self._plan.zone(x0 + 0.1, band.side)
                self._cross_wall(x0, band.y0, band.y1, zone, band.side)
            self._module(band, x0, x1, kind)
            before = (x1, kind)

    def _module(self, band: Band, x0: float, x1: float, kind: str) -> None:
        zone = self._plan.zone((x0 + x1) / 2, band.side)
        if kind == "open":
            self._room(RoomKind.OPEN, band, x0, x1, zone, False)
        elif kind == "flats":
            self._flat(band, x0, x1, zone)
        else:
            self._cells(band, x0, x1, zone, kind)

    def _cells(self, band: Band, x0: float, x1: float, zone: int, kind: str) -> None:
        """Equal rooms side by side, each with its door to the corridor."""
        wide = {"labs": RoomKind.LAB, "meeting": RoomKind.MEETING, "service": RoomKind.SERVICE}
        count = 1 if kind in wide else max(1, round((x1 - x0) / _CELL_WIDTH))
        edges = np.linspace(x0, x1, count + 1)
        loose = 1 - self._config.repetition
        edges[1:-1] += self._rng.normal(0.0, 0.5 * loose, count - 1)
        for index in range(count):
            a, b = float(edges[index]), float(edges[index + 1])
            mirrored = bool(index % 2)
            if index:
                self._cross_wall(a, band.y0, band.y1, zone, band.side)
            if kind == "wards":
                self._ward(band, a, b, zone, mirrored)
                continue
            room = wide.get(kind, RoomKind.CELL)
            glazed = room is RoomKind.MEETING
            self._front(band, a, b, zone, mirrored, Construction.GLASS if glazed else None)
            self._room(room, band, a, b, zone, mirrored)

    def _ward(self, band: Band, x0: float, x1: float, zone: int, mirrored: bool) -> None:
        """A bathroom in the corner at the corridor, the beds beyond it."""
        self._front(band, x0, x1, zone, mirrored, fixed=True)
        inner = self._inward(band, _WET_DEPTH)
        bath_x = x1 - _BATH_WIDTH if not mirrored else x0 + _BATH_WIDTH
        low, high = sorted((band.corridor_y, inner))
        bath = (bath_x, x1) if not mirrored else (x0, bath_x)
        hall = (x0, bath_x) if not mirrored else (bath_x, x1)
        self._wall((bath[0], inner), (bath[1], inner), zone, band.side)
        self._cross_wall(bath_x, low, high, zone, band.side, swing=1 if mirrored else -1)
        self._part(RoomKind.BATH, band, Rectangle(bath[0], low, bath[1], high), zone, mirrored)
        self._part(RoomKind.HALL, band, Rectangle(hall[0], low, hall[1], high), zone, mirrored)
        low, high = sorted((inner, self._outer(band)))
        self._part(RoomKind.WARD, band, Rectangle(x0, low, x1, high), zone, mirrored)

    def _flat(self, band: Band, x0: float, x1: float, zone: int) -> None:
        """Hall and bathroom at the corridor, bedroom and living room at the facade."""
        grid = self._plan.grid
        mirrored = bool(int(grid.bay_at((x0 + x1) / 2)) % 2)
        self._front(band, x0, x1, zone, mirrored, self._block, fixed=True)
        inner = self._inward(band, _WET_DEPTH)
        width = x1 - x0
        bath_x = x1 - 0.25 * width if not mirrored else x0 + 0.25 * width
        split = x0 + width * (0.48 if mirrored else 0.52)
        low, high = sorted((band.corridor_y, inner))
        bath = (bath_x, x1) if not mirrored else (x0, bath_x)
        hall = (x0, bath_x) if not mirrored else (bath_x, x1)
        self._cross_wall(bath_x, low, high, zone, band.side, swing=1 if mirrored else -1)
        # The bedroom's door beside the living room, where the hall still is.
        stretch = self._stretch((x0 + x1) / 2, inner)
        for a, b, at_end in ((x0, split, mirrored), (split, x1, mirrored)):
            doors = self._door(b - a, at_end, fixed=True, stretch=stretch)
            self._wall((a, inner), (b, inner), zone, band.side, doors, swing=_into(band))
        self._part(RoomKind.BATH, band, Rectangle(bath[0], low, bath[1], high), zone, mirrored)
        self._part(RoomKind.HALL, band, Rectangle(hall[0], low, hall[1], high), zone, mirrored)
        low, high = sorted((inner, self._outer(band)))
        self._cross_wall(split, low, high, zone, band.side)
        left, right = Rectangle(x0, low, split, high), Rectangle(split, low, x1, high)
        living, bedroom = (right, left) if mirrored else (left, right)
        self._part(RoomKind.LIVING, band, living, zone, mirrored)
        self._part(RoomKind.BEDROOM, band, bedroom, zone, mirrored)

    def _inward(self, band: Band, depth: float) -> float:
        return band.corridor_y + (depth if band.corridor_y == band.y0 else -depth)

    def _outer(self, band: Band) -> float:
        return band.y1 if band.corridor_y == band.y0 else band.y0

    def _front(
        self,
        band: Band,
        x0: float,
        x1: float,
        zone: int,
        mirrored: bool,
        construction: Construction | None = None,
        fixed: bool = False,
    ) -> None:
        """The wall at the corridor with the door of the room."""
        y = band.corridor_y
        doors = self._door(x1 - x0, mirrored, fixed, self._stretch((x0 + x1) / 2, y))
        made = construction or Construction.STUD
        self._wall((x0, y), (x1, y), zone, band.side, doors, made, _into(band))

    def _door(
        self, length: float, at_end: bool = False, fixed: bool = False, stretch: float = 1.0
    ) -> tuple[Opening, ...]:
        """A door near one end of a wall; anywhere along it in floors of little repetition.

        Args:
            length: of the wall in plan coordinates, metres.
            at_end: near which end.
            fixed: it must be there.
            stretch: plan length per true metre, as doors are of one width.
        """
        width = _DOOR_WIDTH * stretch
        last = length - width - _DOOR_INSET
        if last < _DOOR_INSET:
            return ()
        offset = _DOOR_INSET
        if not fixed and self._rng.random() > self._config.repetition:
            offset = float(self._rng.uniform(_DOOR_INSET, last))
        start = length - offset - width if at_end else offset
        return (Opening(start, start + width, 0.0, DOOR_HEIGHT),)

    def _stretch(self, x: float, y: float) -> float:
        """Plan length per true metre at some place of a curved wing."""
        grid = self._plan.grid
        bay = int(grid.bay_at(x))
        return float(np.diff(grid.stations)[bay]) / grid.length_at(bay, y)

    def _cross_wall(
        self, x: float, y0: float, y1: float, zone: int, side: int, swing: int = 0
    ) -> None:
        """A wall across a band, with a door if it is told to which side that opens."""
        party = self._config.use == "residential" and y1 - y0 > 2 * _WET_DEPTH
        construction = Construction.BLOCK if party else Construction.STUD
        doors = self._door(y1 - y0) if swing else ()
        self._wall((x, y0), (x, y1), zone, side, doors, construction, swing)

    def _wall(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        zone: int,
        side: int,
        doors: tuple[Opening, ...] = (),
        construction: Construction = Construction.STUD,
        swing: int = 1,
    ) -> None:
        name = f"{construction.value} wall {len(self.layout.walls) + 1} {_SIDES[side]}"
        self.layout.walls.append(Wall(name, start, end, zone, doors, construction, swing))

    def _room(
        self, kind: RoomKind, band: Band, x0: float, x1: float, zone: int, mirrored: bool
    ) -> None:
        self._part(kind, band, Rectangle(x0, band.y0, x1, band.y1), zone, mirrored)

    def _part(self, kind: RoomKind, band: Band, area: Rectangle, zone: int, mirrored: bool) -> None:
        nearest = min((area.y0, area.y1), key=lambda y: abs(y - band.corridor_y))
        name = f"{kind.value} {len(self.layout.rooms) + 1} {_SIDES[band.side]}"
        self.layout.rooms.append(Room(name, kind, area, zone, nearest, mirrored))


def _into(band: Band) -> int:
    """How doors in walls along a band swing into its rooms."""
    return 1 if band.corridor_y == band.y0 else -1
