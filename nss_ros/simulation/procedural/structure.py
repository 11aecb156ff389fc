"""The concrete of a floor: slabs, columns, beams, cores with lift shafts and stairs."""

from __future__ import annotations

import math

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.mesh import Mesh, Opening, boxes, cylinders, merge, moved, slab, wall
from nss_ros.simulation.procedural.plan import (
    COLUMN_WIDTH,
    CORE_WALL,
    DOOR_HEIGHT,
    SLAB_OVERHANG,
    Core,
    Plan,
)
from nss_ros.simulation.procedural.programme import DOORS, PROPS_OUT, STUDS, Programme
from nss_ros.simulation.site import Rectangle

_SLAB_THICKNESS = 0.28
_RISER, _TREAD = 0.175, 0.28
_LANDING = 1.25
_PROP_SPACING = 1.4
_ALWAYS = -math.inf


def build_structure(
    plan: Plan,
    programme: Programme,
    standing: bool,
    deviation: float,
    rng: np.random.Generator,
) -> list[Element]:
    """All concrete, at every stage, and the props below the slab above at the first.

    Args:
        plan: of the structure; meshes are in its coordinates.
        programme: of the works.
        standing: the building is in use at first, as in a renovation.
        deviation: factor of the deviations from plan.
        rng: of the deviations.
    """
    elements = _slabs(plan, programme)
    always = programme.always
    for (x, y), name in _column_places(plan):
        mesh = _column(x, y, plan.height, deviation, rng)
        elements.append(Element("column", always, mesh, name=name))
    elements += [Element("beam", always, mesh, name=name) for mesh, name in _beams(plan)]
    for index, core in enumerate(plan.cores, start=1):
        elements += _core(plan, core, programme, standing, f"core {index}")
    if not standing:
        elements += _props(plan, programme, rng)
    return [element for element in elements if element.stages]


def _slabs(plan: Plan, programme: Programme) -> list[Element]:
    holes = [(h.x0, h.y0, h.x1, h.y1) for h in plan.holes()]
    down = [(h.x0, h.y0, h.x1, h.y1) for h in (core.stair_hole for core in plan.cores)]
    up = [(s.x0, s.y0, s.x1, s.y1) for s in (core.stair for core in plan.cores)]
    elements = []
    for bay in range(plan.grid.bays):
        (x0, y0), (x1, y1) = _slab_corners(plan, bay)
        bottom, top = (x0, y0, -_SLAB_THICKNESS), (x1, y1, 0.0)
        above = (x0, y0, plan.height), (x1, y1, plan.height + _SLAB_THICKNESS)
        for kind, mesh in (
            ("floor_slab", slab(bottom, top, holes + down)),
            ("ceiling_slab", slab(*above, holes + up)),
        ):
            name = f"{kind.replace('_', ' ')} bay {bay + 1}"
            elements.append(Element(kind, programme.always, mesh, name=name))
    return elements


def _slab_corners(plan: Plan, bay: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """A bay with what overhangs at the ends and facades, but not at an inner corner."""
    grid = plan.grid
    x0, x1 = float(grid.stations[bay]), float(grid.stations[bay + 1])
    near = 0.02 if grid.length_at(bay, 0.0) < 0.1 else -SLAB_OVERHANG
    far = grid.depth - 0.02 if grid.length_at(bay, grid.depth) < 0.1 else grid.depth + SLAB_OVERHANG
    if bay == 0:
        x0 -= SLAB_OVERHANG
    if bay == grid.bays - 1:
        x1 += SLAB_OVERHANG
    return (x0, near), (x1, far)


def _column_places(plan: Plan) -> list[tuple[tuple[float, float], str]]:
    grid = plan.grid
    inset = COLUMN_WIDTH / 2 + 0.05
    places = []
    for line, station in enumerate(grid.stations):
        x = float(np.clip(station, inset, grid.length - inset))
        # Grid lines of a corner meet at its inner end; one column there is enough.
        corner = line in grid.corners and line - 1 in grid.corners
        for row, y in enumerate(plan.rows):
            inner = np.allclose(grid.far[line], grid.far[line - 1]) if corner else False
            shut = corner and (y > grid.depth * 0.6 if inner else y < grid.depth * 0.4)
            if not shut and not any(_within(core.area, x, y, 0.6) for core in plan.cores):
                places.append(((x, y), f"column {line + 1}-{chr(ord('A') + row)}"))
    return places


def _within(area: Rectangle, x: float, y: float, margin: float) -> bool:
    inside_x = area.x0 - margin < x < area.x1 + margin
    return inside_x and area.y0 - margin < y < area.y1 + margin


def _column(x: float, y: float, height: float, deviation: float, rng: np.random.Generator) -> Mesh:
    half = COLUMN_WIDTH / 2 + rng.normal(0.0, 0.003 * deviation)
    shift = rng.normal(0.0, 0.006 * deviation, 2)
    column = boxes((-half, -half, 0.0), (half, half, height))
    turned = from_yaw(rng.normal(0.0, 0.006 * deviation), (x + shift[0], y + shift[1], 0.0))
    return moved(column, turned)


def _beams(plan: Plan) -> list[tuple[Mesh, str]]:
    """Main beams along the rows, lower ones from row to row along the grid lines."""
    if plan.beam_depth == 0:
        return []
    grid, bottom = plan.grid, plan.height - plan.beam_depth
    beams = []
    for bay in range(grid.bays):
        x0, x1 = float(grid.stations[bay]), float(grid.stations[bay + 1])
        lower = [(x0, y - 0.15, bottom) for y in plan.rows]
        upper = [(x1, y + 0.15, plan.height) for y in plan.rows]
        beams.append((boxes(lower, upper), f"beams bay {bay + 1}"))
    for line, station in enumerate(grid.stations):
        x = float(np.clip(station, 0.15, grid.length - 0.15))
        ends = (x - 0.12, 0.02, bottom + 0.1), (x + 0.12, grid.depth - 0.02, plan.height)
        beams.append((boxes(*ends), f"beam line {line + 1}"))
    return beams


def _core(plan: Plan, core: Core, programme: Programme, standing: bool, name: str) -> list[Element]:
    always = programme.always
    zone = plan.zone(core.area.x0 + 0.1, 1)
    walls = [
        Element("core_wall", always, mesh, name=f"{name}, {part} wall")
        for part, mesh in _core_walls(plan, core)
    ]
    stairs = Element("stairs", always, _stairs(plan, core), name=f"{name}, stairs")
    guards, doors = _lift_guard(core), _lift_doors(core)
    doors_in, rails_in = (_ALWAYS, _ALWAYS) if standing else (DOORS, STUDS)
    return [
        *walls,
        stairs,
        Element(
            "guard", programme.during(zone, _ALWAYS, doors_in), guards, name=f"{name}, lift guard"
        ),
        Element(
            "lift_door",
            programme.during(zone, doors_in),
            doors,
            Material.METAL,
            f"{name}, lift doors",
        ),
        Element(
            "handrail",
            programme.during(zone, rails_in),
            _handrail(core),
            Material.METAL,
            f"{name}, handrail",
        ),
    ]


def _core_walls(plan: Plan, core: Core) -> list[tuple[str, Mesh]]:
    area, top = core.area, plan.height
    front_y = core.door_y if core.door_y == area.y0 else core.door_y - CORE_WALL
    lift, stair = core.lift, core.stair
    middle = (lift.x0 + lift.x1) / 2 - area.x0
    openings = [
        Opening(middle - 0.55, middle + 0.55, 0.0, DOOR_HEIGHT + 0.1),
        Opening(stair.x1 - area.x0 - 1.15, stair.x1 - area.x0 - 0.15, 0.0, DOOR_HEIGHT),
    ]
    front = wall(area.x1 - area.x0, (0.0, 0.0), (CORE_WALL, top), openings)
    back_y = area.y1 - CORE_WALL if front_y == area.y0 else area.y0
    cross = [
        ("west", area.x0),
        ("lift", lift.x1),
        ("shaft", stair.x1),
        ("east", area.x1 - CORE_WALL),
    ]
    sides = [(part, boxes((x, area.y0, 0.0), (x + CORE_WALL, area.y1, top))) for part, x in cross]
    return [
        ("front", moved(front, from_yaw(0.0, (area.x0, front_y, 0.0)))),
        ("back", boxes((area.x0, back_y, 0.0), (area.x1, back_y + CORE_WALL, top))),
        ("lift back", boxes((lift.x0, lift.y1, 0.0), (lift.x1, lift.y1 + 0.2, top))),
        *sides,
    ]


def _stairs(plan: Plan, core: Core) -> Mesh:
    """A flight up to the landing at the back, one on from it, and the one from below."""
    stair, hole = core.stair, core.stair_hole
    inward = 1.0 if core.door_y < (stair.y0 + stair.y1) / 2 else -1.0
    start = core.door_y + inward * (CORE_WALL + _LANDING)
    run = abs(stair.y1 - stair.y0) - 2 * _LANDING
    count = int(min(plan.height / 2 / _RISER, max(run, 1.2) / _TREAD))
    rise = plan.height / 2 / count
    steps = np.arange(count)
    middle = (stair.x0 + stair.x1) / 2
    up = _flight(middle + 0.05, stair.x1, start, inward, steps, rise * (steps + 1))
    on = _flight(stair.x0, middle - 0.05, start, inward, steps, plan.height - rise * steps)
    below = _flight(hole.x0, hole.x1 - 0.05, start, inward, steps, -rise * (steps + 1))
    landing_start = start + inward * count * _TREAD
    back = stair.y1 if inward > 0 else stair.y0
    low, high = sorted((landing_start, back))
    top = plan.height / 2
    landing = boxes((stair.x0, low, top - 0.2), (stair.x1, high, top))
    return merge([up, on, below, landing])


def _flight(
    x0: float, x1: float, start: float, inward: float, steps: np.ndarray, tops: np.ndarray
) -> Mesh:
    a, b = start + inward * _TREAD * steps, start + inward * _TREAD * (steps + 1)
    lower = np.stack((np.full(len(steps), x0), np.minimum(a, b), tops - 0.3), axis=1)
    upper = np.stack((np.full(len(steps), x1), np.maximum(a, b), tops), axis=1)
    return boxes(lower, upper)


def _lift_guard(core: Core) -> Mesh:
    """Boards across the opening of the shaft."""
    x = (core.lift.x0 + core.lift.x1) / 2
    y = core.door_y if core.door_y == core.area.y0 else core.door_y + 0.04
    heights = np.array([0.05, 0.5, 0.95])
    lower = [(x - 0.7, y - 0.04, z) for z in heights]
    upper = [(x + 0.7, y, z + 0.15) for z in heights]
    return boxes(lower, upper)


def _lift_doors(core: Core) -> Mesh:
    x = (core.lift.x0 + core.lift.x1) / 2
    y = core.door_y + (0.1 if core.door_y == core.area.y0 else -0.13)
    return boxes((x - 0.55, y, 0.0), (x + 0.55, y + 0.03, DOOR_HEIGHT + 0.1))


def _handrail(core: Core) -> Mesh:
    """Posts and rail around the hole of the stair."""
    hole = core.stair_hole
    x = hole.x1 + 0.03
    posts = np.arange(hole.y0, hole.y1, 1.0)
    lower = [(x, y, 0.0) for y in posts]
    upper = [(x, y, 1.0) for y in posts]
    rails = [((x, hole.y0, z), (x, hole.y1, z)) for z in (0.5, 1.0)]
    starts, ends = [*lower, *(a for a, _ in rails)], [*upper, *(b for _, b in rails)]
    return cylinders(starts, ends, 0.025, sides=6)


def _props(plan: Plan, programme: Programme, rng: np.random.Generator) -> list[Element]:
    """Shoring below a slab that was just poured, bay by bay, until it bears itself."""
    elements = []
    for bay in range(plan.grid.bays):
        stages = programme.during(
            plan.zone(float(plan.grid.stations[bay]) + 0.1, 1), _ALWAYS, PROPS_OUT
        )
        if bay in plan.grid.corners or not stages:
            continue
        x0, x1 = plan.grid.stations[bay], plan.grid.stations[bay + 1]
        x, y = np.meshgrid(
            np.arange(x0 + 0.7, x1 - 0.4, _PROP_SPACING),
            np.arange(0.7, plan.grid.depth - 0.4, _PROP_SPACING),
        )
        places = np.stack((x.ravel(), y.ravel()), axis=1)
        places += rng.normal(0.0, 0.05, places.shape)
        kept = [
            place
            for place in places.tolist()
            if not any(_within(core.area, place[0], place[1], 0.3) for core in plan.cores)
        ]
        mesh = _shoring(np.array(kept).reshape(-1, 2), plan.height)
        elements.append(Element("prop", stages, mesh, Material.METAL, f"props bay {bay + 1}"))
    return elements


def _shoring(places: np.ndarray, height: float) -> Mesh:
    """Telescopic props with foot and head plates."""
    feet = np.column_stack((places, np.zeros(len(places))))
    reach, plate = np.array([0.0, 0.0, height]), np.array([0.08, 0.08, 0.012])
    split = reach * 0.55
    return merge(
        [
            cylinders(feet, feet + split, 0.032, sides=8),
            cylinders(feet + split, feet + reach, 0.024, sides=8),
            boxes(feet - plate * (1, 1, 0), feet + plate),
            boxes(feet + reach - plate, feet + reach + plate * (1, 1, 0)),
        ]
    )
