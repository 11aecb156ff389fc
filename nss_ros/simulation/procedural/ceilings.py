"""Dropped ceilings, first their grids and then their tiles, and raised floors."""

from __future__ import annotations

import numpy as np

from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.mesh import Mesh, boxes, merge
from nss_ros.simulation.procedural.layout import Room, RoomKind
from nss_ros.simulation.procedural.plan import Plan
from nss_ros.simulation.procedural.programme import (
    CEILING_GRIDS,
    CEILING_TILES,
    RAISED_FLOORS,
    Programme,
)

_TILE = 0.6
_INSET = 0.08
_BAR = 0.024
RAISED_HEIGHT = 0.15
_WITHOUT_CEILING = {RoomKind.LIVING, RoomKind.BEDROOM, RoomKind.LOBBY, RoomKind.SERVICE}
_SHARE_RAISED = 0.25  # of the open-plan rooms of offices


def build_ceilings(
    plan: Plan, rooms: list[Room], programme: Programme, rng: np.random.Generator
) -> list[Element]:
    """Ceilings of a layout's rooms, plan coordinates; some tiles are left out."""
    elements = []
    open_too = bool(rng.random() < 0.6)
    for room in rooms:
        delay = float(rng.normal(0.0, 0.3))
        if room.kind in _WITHOUT_CEILING or (room.kind is RoomKind.OPEN and not open_too):
            continue
        z = plan.ceiling_height - (0.12 if room.kind is RoomKind.BATH else 0.0)
        parts = (
            ("ceiling_grid", CEILING_GRIDS, _grid(room, z, plan.height), Material.METAL),
            ("ceiling_tiles", CEILING_TILES, _tiles(room, z, rng), Material.MATT),
        )
        for kind, start, mesh, material in parts:
            stages = programme.during(room.zone, start + delay)
            if stages and len(mesh.triangles):
                name = f"{room.name}, {kind.replace('_', ' ')}"
                elements.append(Element(kind, stages, mesh, material, name))
    return elements


def draw_raised_floors(
    rooms: list[Room], programme: Programme, rng: np.random.Generator
) -> dict[str, frozenset[int]]:
    """A few open-plan rooms with raised floors, late in the works: stages by name of the room.

    No tripod stands on them: spots are found on the bare slab.
    """
    chosen = [r for r in rooms if r.kind is RoomKind.OPEN and rng.random() < _SHARE_RAISED]
    return {room.name: programme.during(room.zone, RAISED_FLOORS) for room in chosen}


def build_raised_floors(
    rooms: list[Room], raised: dict[str, frozenset[int]], rng: np.random.Generator
) -> list[Element]:
    """The raised floors that were drawn, plan coordinates."""
    return [
        Element(
            "raised_floor", raised[room.name], _panels(room, rng), name=f"{room.name}, raised floor"
        )
        for room in rooms
        if raised.get(room.name)
    ]


def _lines(low: float, high: float) -> np.ndarray:
    """Edges of whole tiles in the middle and cut ones at the walls."""
    start = low + ((high - low) % _TILE) / 2
    return np.concatenate(([low], np.arange(start, high, _TILE), [high]))


def _grid(room: Room, z: float, top: float) -> Mesh:
    area = room.area
    xs, ys = _lines(area.x0 + _INSET, area.x1 - _INSET), _lines(area.y0 + _INSET, area.y1 - _INSET)
    lower = [(x - _BAR / 2, ys[0], z - 0.035) for x in xs]
    upper = [(x + _BAR / 2, ys[-1], z) for x in xs]
    lower += [(xs[0], y - _BAR / 2, z - 0.035) for y in ys]
    upper += [(xs[-1], y + _BAR / 2, z) for y in ys]
    rods = [(x, y) for x in xs[1:-1:2] for y in ys[1:-1:2]]
    lower += [(x - 0.003, y - 0.003, z) for x, y in rods]
    upper += [(x + 0.003, y + 0.003, top) for x, y in rods]
    return boxes(lower, upper)


def _tiles(room: Room, z: float, rng: np.random.Generator) -> Mesh:
    area = room.area
    xs, ys = _lines(area.x0 + _INSET, area.x1 - _INSET), _lines(area.y0 + _INSET, area.y1 - _INSET)
    low = np.stack(np.meshgrid(xs[:-1], ys[:-1], [z], indexing="ij"), -1).reshape(-1, 3)
    high = np.stack(np.meshgrid(xs[1:], ys[1:], [z + 0.015], indexing="ij"), -1).reshape(-1, 3)
    laid = rng.random(len(low)) < rng.choice([0.9, 0.97, 1.0])
    return boxes(low[laid], high[laid])


def _panels(room: Room, rng: np.random.Generator) -> Mesh:
    """Panels with narrow joints; a few are still off, at the edge from where one works."""
    area = room.area
    xs, ys = _lines(area.x0 + 0.1, area.x1 - 0.1), _lines(area.y0 + 0.1, area.y1 - 0.1)
    low = np.stack(np.meshgrid(xs[:-1], ys[:-1], [RAISED_HEIGHT - 0.035], indexing="ij"), -1)
    high = np.stack(np.meshgrid(xs[1:], ys[1:], [RAISED_HEIGHT], indexing="ij"), -1)
    kept = rng.random(low.shape[:2]) < 0.98
    joint = np.array([0.002, 0.002, 0.0])
    lower, upper = low[kept] + joint, high[kept] - joint
    feet = low[kept]
    below = boxes(feet * (1, 1, 0), feet + np.array([0.03, 0.03, 0.0]))
    return merge([boxes(lower, upper), below])
