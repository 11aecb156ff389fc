"""Where things stand: rubbish, stacks and tools that move from stage to stage, and furniture.

Whatever is put down stands neither in a wall or a column, nor in the swing of a door, nor in
another thing. What hangs from the ceiling may be anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import SiteConfig
from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Element, stages_from
from nss_ros.simulation.mesh import Mesh, merge, moved
from nss_ros.simulation.procedural.ceilings import RAISED_HEIGHT
from nss_ros.simulation.procedural.furniture import furnish
from nss_ros.simulation.procedural.layout import Layout, Room, RoomKind
from nss_ros.simulation.procedural.plan import COLUMN_WIDTH, Plan
from nss_ros.simulation.procedural.programme import CEILING_GRIDS, FURNITURE, Programme
from nss_ros.simulation.procedural.temporary import TEMPORARIES, Temporary
from nss_ros.simulation.procedural.things import DENSITIES, STAYS, Thing, draw_thing
from nss_ros.simulation.site import Rectangle

_CORRIDOR_SHARE = 0.5  # of that in corridors, where one has to get through
_PHASE_STARTS = (-2.0, 0.0, 1.8, 4.4, 7.4)
_DOOR_CLEARANCE = 0.9
_TRIES = 30
_WALL_MARGIN = 0.12
_NARROW = 0.4  # half the depth of what may stand in a corridor, metres


@dataclass(frozen=True, slots=True)
class _Disc:
    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
class _Standing:
    """Room taken up by something, and the stages at which it is."""

    disc: _Disc
    stages: frozenset[int]


def build_contents(
    plan: Plan,
    layout: Layout,
    raised: dict[str, frozenset[int]],
    programme: Programme,
    config: SiteConfig,
    rng: np.random.Generator,
) -> list[Element]:
    """Furniture of all rooms and, while it is not a former layout, the clutter of the works.

    Args:
        plan: of the structure.
        layout: rooms, and walls whose doors are kept free.
        raised: stages at which a room's floor is raised, by its name.
        programme: of the works.
        config: how much clutter and how many temporary things, and how far furniture stands out
            of place.
        rng: of everything.

    Returns:
        Elements in the map frame.
    """
    furniture_rng, clutter_rng, temporary_rng = rng.spawn(3)
    doors, columns = _doors(layout, plan), _columns(plan)
    elements = []
    for room in layout.rooms:
        keep_free = _near(doors, room.area), _near(columns, room.area)
        floor = _Floor(plan, room, raised.get(room.name, frozenset()), *keep_free, [])
        elements += _furnished(floor, programme, config, furniture_rng)
        if not programme.former and config.clutter > 0:
            elements += _cluttered(floor, programme, config.clutter, clutter_rng)
        if not programme.former and config.temporary > 0:
            elements += _temporary(floor, programme, config.temporary, temporary_rng)
    return elements


@dataclass(frozen=True, slots=True)
class _Floor:
    """The floor of a room with what is on it.

    Attributes:
        plan: of the structure.
        room: whose floor it is.
        raised: stages at which it is raised.
        doors: (n, 2) nearby doors, plan coordinates.
        columns: (n, 2) nearby columns.
        standing: what stands there at which stages; grows.
    """

    plan: Plan
    room: Room
    raised: frozenset[int]
    doors: NDArray[np.float64]
    columns: NDArray[np.float64]
    standing: list[_Standing]

    def taken(self, stages: frozenset[int]) -> list[_Disc]:
        """What stands there at some of these stages."""
        return [item.disc for item in self.standing if item.stages & stages]


def _furnished(
    floor: _Floor, programme: Programme, config: SiteConfig, rng: np.random.Generator
) -> list[Element]:
    room = floor.room
    stages = programme.during(room.zone, FURNITURE + float(rng.normal(0.0, 0.25)))
    pieces = furnish(room, config.deviation, rng)
    if not stages:
        return []
    elements = []
    for index, piece in enumerate(pieces, start=1):
        pose = floor.plan.grid.frame(piece.x, piece.y) @ from_yaw(piece.yaw, (0.0, 0.0, 0.0))
        mesh = _on_floor(moved(piece.mesh, pose), floor, stages)
        elements.append(
            Element(piece.kind, stages, mesh, name=f"{piece.kind} {index}, {room.name}")
        )
        disc = _Disc(piece.x, piece.y, _radius(piece.mesh))
        floor.standing.append(_Standing(disc, stages))
    return elements


def _on_floor(mesh: Mesh, floor: _Floor, stages: frozenset[int]) -> Mesh:
    """A thing as it stands, on the raised floor where there is one all the while."""
    if not stages <= floor.raised:
        return mesh
    return Mesh(mesh.vertices + np.array([0.0, 0.0, RAISED_HEIGHT]), mesh.triangles)


def _cluttered(
    floor: _Floor, programme: Programme, amount: float, rng: np.random.Generator
) -> list[Element]:
    """Things put down at each stage, some of which stay for the next one."""
    elements = []
    room = floor.room
    share = _CORRIDOR_SHARE if room.kind is RoomKind.CORRIDOR else 1.0
    density = np.array(DENSITIES) * (amount * share)
    for stage in range(1, programme.stages + 1):
        phase = _phase(programme.times[room.zone, stage - 1])
        for _ in range(int(rng.poisson(room.area.area * density[phase]))):
            thing = draw_thing(phase, rng)
            stages = _draw_stages(stage, floor, programme, rng)
            spot = _place(thing, floor, floor.taken(stages), rng)
            if spot is None:
                continue
            mesh, disc = _on_floor(spot[0], floor, stages), spot[1]
            floor.standing.append(_Standing(disc, stages))
            name = f"{thing.kind.replace('_', ' ')} {len(floor.standing)}, {room.name}"
            elements.append(Element(thing.kind, stages, mesh, thing.material, name))
    return elements


def _temporary(
    floor: _Floor, programme: Programme, amount: float, rng: np.random.Generator
) -> list[Element]:
    """Small and hanging things of each stage; those of a kind and of the same stages as one."""
    room, found = floor.room, dict[tuple[Temporary, frozenset[int]], list[Mesh]]()
    for stage in range(1, programme.stages + 1):
        time = programme.times[room.zone, stage - 1]
        top = floor.plan.height if time < CEILING_GRIDS else floor.plan.ceiling_height
        for thing in TEMPORARIES:
            density = amount * thing.density * thing.shares[_phase(time)]
            for _ in range(int(rng.poisson(room.area.area * density))):
                shape, stages = thing.make(rng, top), _draw_stages(stage, floor, programme, rng)
                mesh = _scattered(thing, shape, stages, floor, rng)
                if mesh is not None:
                    found.setdefault((thing, stages), []).append(mesh)
    return [
        Element(thing.kind, stages, merge(meshes), name=f"{thing.kind}, {room.name}")
        for (thing, stages), meshes in found.items()
    ]


def _scattered(
    thing: Temporary,
    shape: Mesh,
    stages: frozenset[int],
    floor: _Floor,
    rng: np.random.Generator,
) -> Mesh | None:
    """The thing somewhere in the room, map frame; None if it does not fit where it was drawn.

    It is not tried elsewhere, so that what is full already does not get fuller until nobody can
    put up a tripod.
    """
    if thing.wide and floor.room.kind is RoomKind.CORRIDOR:
        return None
    area = floor.room.area
    yaw = rng.uniform(-np.pi, np.pi)
    x, y = rng.uniform(area.x0, area.x1), rng.uniform(area.y0, area.y1)
    extent = _extent(np.abs(shape.vertices[:, :2]).max(axis=0), yaw)
    disc = _Disc(x, y, _radius(shape))
    if thing.hangs:
        if not _inside(disc, extent, floor):
            return None
    elif not _fits(disc, extent, floor) or any(_touch(disc, o) for o in floor.taken(stages)):
        return None
    else:
        floor.standing.append(_Standing(disc, stages))
        shape = _on_floor(shape, floor, stages)
    return moved(shape, floor.plan.grid.frame(x, y) @ from_yaw(yaw, (0.0, 0.0, 0.0)))


def _phase(time: float) -> int:
    """Of `things.PHASES`, by the steps of work done."""
    return int(np.searchsorted(_PHASE_STARTS, time, "right"))


def _draw_stages(
    stage: int, floor: _Floor, programme: Programme, rng: np.random.Generator
) -> frozenset[int]:
    """The stages of a thing that is put down at one: most are gone at the next."""
    stays = stage < programme.stages and rng.random() < STAYS
    if stays and (stage in floor.raised) == (stage + 1 in floor.raised):
        return stages_from(stage, stage + 1)
    return stages_from(stage, stage)


def _place(
    thing: Thing, floor: _Floor, taken: list[_Disc], rng: np.random.Generator
) -> tuple[Mesh, _Disc] | None:
    """The thing where it fits, map frame; None if it does not after some tries."""
    shape = thing.make(rng)
    half = np.abs(shape.vertices[:, :2]).max(axis=0)
    narrow = floor.room.kind is RoomKind.CORRIDOR
    if narrow and half.min() > _NARROW:
        return None
    for _ in range(_TRIES):
        yaw, x, y = _position(floor.room.area, half, thing.against_wall or narrow, rng)
        disc = _Disc(x, y, _radius(shape))
        if _fits(disc, _extent(half, yaw), floor) and not any(_touch(disc, o) for o in taken):
            pose = floor.plan.grid.frame(x, y) @ from_yaw(yaw, (0.0, 0.0, 0.0))
            return moved(shape, pose), disc
    return None


def _position(
    area: Rectangle, half: NDArray[np.float64], against_wall: bool, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Yaw, x and y: along one of the four sides of the room, or anywhere."""
    gap = _WALL_MARGIN + rng.uniform(0.03, 0.15)
    if not against_wall:
        yaw = float(rng.choice([0.0, np.pi / 2])) + rng.normal(0.0, 0.25)
        return yaw, rng.uniform(area.x0, area.x1), rng.uniform(area.y0, area.y1)
    wobble = rng.normal(0.0, np.radians(2.5))
    sides = 2 if area.x1 - area.x0 > 2 * (area.y1 - area.y0) else 4
    side = int(rng.integers(sides))
    if side < 2:
        y = area.y0 + half[1] + gap if side == 0 else area.y1 - half[1] - gap
        return side * np.pi + wobble, rng.uniform(area.x0, area.x1), float(y)
    x = area.x0 + half[1] + gap if side == 2 else area.x1 - half[1] - gap
    yaw = (-np.pi / 2 if side == 2 else np.pi / 2) + wobble
    return yaw, float(x), rng.uniform(area.y0, area.y1)


def _extent(half: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    cosine, sine = abs(np.cos(yaw)), abs(np.sin(yaw))
    return np.array([cosine * half[0] + sine * half[1], sine * half[0] + cosine * half[1]])


def _fits(disc: _Disc, extent: NDArray[np.float64], floor: _Floor) -> bool:
    """Inside the room, clear of its walls, of doors and of columns."""
    if not _inside(disc, extent, floor):
        return False
    place = np.array([disc.x, disc.y])
    reach = extent + COLUMN_WIDTH / 2 + 0.05
    if (np.abs(floor.columns - place) < reach).all(axis=1).any():
        return False
    beyond = np.maximum(np.abs(floor.doors - place) - extent, 0.0)
    return not (np.linalg.norm(beyond, axis=1) < _DOOR_CLEARANCE).any()


def _inside(disc: _Disc, extent: NDArray[np.float64], floor: _Floor) -> bool:
    """In the room, clear of its walls."""
    place, area = np.array([disc.x, disc.y]), floor.room.area
    low, high = place - extent - _WALL_MARGIN, place + extent + _WALL_MARGIN
    return not (low[0] < area.x0 or low[1] < area.y0 or high[0] > area.x1 or high[1] > area.y1)


def _radius(mesh: Mesh) -> float:
    return float(np.hypot(*np.abs(mesh.vertices[:, :2]).max(axis=0))) * 0.9


def _touch(one: _Disc, other: _Disc) -> bool:
    return bool(np.hypot(one.x - other.x, one.y - other.y) < one.radius + other.radius)


def _near(points: NDArray[np.float64], area: Rectangle) -> NDArray[np.float64]:
    """Of points (n, 2) those in an area or within some metres of it."""
    low, high = np.array([area.x0, area.y0]) - 2.0, np.array([area.x1, area.y1]) + 2.0
    return np.asarray(points[((points > low) & (points < high)).all(axis=1)])


def _columns(plan: Plan) -> NDArray[np.float64]:
    x, y = np.meshgrid(plan.grid.stations, plan.rows)
    return np.stack((x.ravel(), y.ravel()), axis=1)


def _doors(layout: Layout, plan: Plan) -> NDArray[np.float64]:
    """Middles of all doors, those of the cores among them."""
    middles = [
        (wall.pose @ [(door.start + door.end) / 2, 0.0, 0.0, 1.0])[:2]
        for wall in layout.walls
        for door in wall.doors
    ]
    for core in plan.cores:
        middles.append(np.array([(core.lift.x0 + core.lift.x1) / 2, core.door_y]))
        middles.append(np.array([core.stair.x1 - 0.65, core.door_y]))
    return np.array(middles).reshape(-1, 2)
