"""The shell of a floor: slabs, columns, beams, facade and core. It is there at every stage."""

from __future__ import annotations

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Element, stages_from
from nss_ros.simulation.mesh import Mesh, Opening, box, merge, moved, wall
from nss_ros.simulation.procedural.plan import (
    BEAM_DEPTH,
    COLUMN_WIDTH,
    DOOR_HEIGHT,
    FACADE_THICKNESS,
    Plan,
)
from nss_ros.simulation.site import Rectangle

_SLAB_THICKNESS = 0.25
_SLAB_OVERHANG = FACADE_THICKNESS + 0.1
_CORE_WALL = 0.2
_FRAME_WIDTH = 0.07


def build_structure(plan: Plan, stages: int, rng: np.random.Generator) -> list[Element]:
    """Slabs, columns, beams, core and facade, with window frames from the second stage on."""
    always = stages_from(1, stages)
    shaft = Rectangle(
        plan.core.x0 + _CORE_WALL,
        plan.core.y0 + _CORE_WALL,
        plan.core.x0 + 1.6,
        plan.core.y1 - _CORE_WALL,
    )
    elements = [
        Element("floor_slab", always, _slab(plan, shaft, -_SLAB_THICKNESS)),
        Element("ceiling_slab", always, _slab(plan, shaft, plan.height)),
    ]
    elements += [Element("column", always, mesh) for mesh in _columns(plan)]
    elements += [Element("beam", always, mesh) for mesh in _beams(plan)]
    elements += [Element("core_wall", always, mesh) for mesh in _core(plan)]
    elements.append(Element("stairs", always, _stairs(plan)))
    for mesh, frame in _facade(plan, rng):
        elements.append(Element("facade", always, mesh))
        if stages >= 2:
            elements.append(Element("window_frame", stages_from(2, stages), frame))
    return elements


def _slab(plan: Plan, hole: Rectangle, bottom: float) -> Mesh:
    top = bottom + _SLAB_THICKNESS
    x0, y0 = -_SLAB_OVERHANG, -_SLAB_OVERHANG
    x1, y1 = plan.width + _SLAB_OVERHANG, plan.depth + _SLAB_OVERHANG
    return merge(
        [
            box((x0, y0, bottom), (x1, hole.y0, top)),
            box((x0, hole.y1, bottom), (x1, y1, top)),
            box((x0, hole.y0, bottom), (hole.x0, hole.y1, top)),
            box((hole.x1, hole.y0, bottom), (x1, hole.y1, top)),
        ]
    )


def _columns(plan: Plan) -> list[Mesh]:
    half = COLUMN_WIDTH / 2
    core = plan.core
    return [
        box((x - half, y - half, 0.0), (x + half, y + half, plan.height))
        for x in plan.columns_x
        for y in plan.columns_y
        if not (core.x0 - 0.5 < x < core.x1 + 0.5 and core.y0 - 0.5 < y < core.y1 + 0.5)
    ]


def _beams(plan: Plan) -> list[Mesh]:
    bottom = plan.height - BEAM_DEPTH
    along_x = [
        box((0.0, y - 0.15, bottom), (plan.width, y + 0.15, plan.height)) for y in plan.columns_y
    ]
    secondary = bottom + 0.15
    along_y = [
        box((x - 0.1, 0.0, secondary), (x + 0.1, plan.depth, plan.height)) for x in plan.columns_x
    ]
    return along_x + along_y


def _core(plan: Plan) -> list[Mesh]:
    core, top = plan.core, plan.height
    thick = _CORE_WALL
    width, depth = core.x1 - core.x0, core.y1 - core.y0
    lift = Opening(0.45, 1.45, 0.0, DOOR_HEIGHT + 0.1)
    stair = Opening(2.1, 3.1, 0.0, DOOR_HEIGHT + 0.1)
    front = moved(
        wall(width, (0.0, 0.0), (thick, top), [lift, stair]), from_yaw(0.0, (core.x0, core.y0, 0.0))
    )
    sides = [
        box((core.x0, core.y0 + thick, 0.0), (core.x0 + thick, core.y1, top)),
        box((core.x1 - thick, core.y0 + thick, 0.0), (core.x1, core.y1, top)),
        box((core.x0 + 1.6, core.y0 + thick, 0.0), (core.x0 + 1.8, core.y0 + depth, top)),
        box((core.x0, core.y1 - thick, 0.0), (core.x1, core.y1, top)),
    ]
    return [front, *sides]


def _stairs(plan: Plan) -> Mesh:
    """A flight up from the door of the stair to the back of the core."""
    core = plan.core
    start = core.y0 + 1.2
    count = int((core.y1 - _CORE_WALL - start) / 0.27)
    return merge(
        [
            box(
                (core.x0 + 1.8, start + 0.27 * step, 0.17 * step),
                (core.x1 - _CORE_WALL, start + 0.27 * (step + 1), 0.17 * (step + 1)),
            )
            for step in range(count)
        ]
    )


def _facade(plan: Plan, rng: np.random.Generator) -> list[tuple[Mesh, Mesh]]:
    """Four walls (with corners) and the frames of their windows."""
    out = FACADE_THICKNESS
    sides = [
        (plan.width + 2 * out, from_yaw(0.0, (-out, -out, 0.0))),
        (plan.depth, from_yaw(np.pi / 2, (plan.width + out, 0.0, 0.0))),
        (plan.width + 2 * out, from_yaw(np.pi, (plan.width + out, plan.depth + out, 0.0))),
        (plan.depth, from_yaw(-np.pi / 2, (-out, plan.depth, 0.0))),
    ]
    result = []
    for length, T_map_wall in sides:
        openings = _windows(length, rng)
        frames = [_frame(opening) for opening in openings]
        result.append(
            (
                moved(wall(length, (0.0, 0.0), (out, plan.height), openings), T_map_wall),
                moved(merge(frames), T_map_wall),
            )
        )
    return result


def _windows(length: float, rng: np.random.Generator) -> list[Opening]:
    """Windows of a few widths, some of them down to the floor, with solid piers between."""
    openings: list[Opening] = []
    position = rng.uniform(0.8, 1.6)
    while True:
        width = float(rng.choice([0.9, 1.2, 1.8, 2.4]))
        if position + width > length - 0.7:
            return openings
        sill = float(rng.choice([0.85, 0.85, 0.85, 0.1]))
        openings.append(Opening(position, position + width, sill, 2.35))
        position += width + rng.uniform(0.6, 2.2)


def _frame(opening: Opening) -> Mesh:
    """A frame with mullions; glass gives no return, so there is none."""
    width = opening.end - opening.start
    count = max(1, round(width / 0.9))
    edges = np.linspace(opening.start, opening.end - _FRAME_WIDTH, count + 1)
    near, far = 0.12, 0.12 + _FRAME_WIDTH
    posts = [box((x, near, opening.bottom), (x + _FRAME_WIDTH, far, opening.top)) for x in edges]
    rails = [
        box((opening.start, near, z), (opening.end, far, z + _FRAME_WIDTH))
        for z in (opening.bottom, opening.top - _FRAME_WIDTH)
    ]
    return merge(posts + rails)
