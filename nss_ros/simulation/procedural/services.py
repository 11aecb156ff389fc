"""Ducts, pipes and cable trays under the ceiling slab, and the ceilings that hide them."""

from __future__ import annotations

import numpy as np

from nss_ros.simulation.element import Element, stages_from
from nss_ros.simulation.mesh import Mesh, box, cylinder, merge
from nss_ros.simulation.procedural.plan import BEAM_DEPTH, Plan
from nss_ros.simulation.site import Rectangle

_CEILING_HEIGHT = 2.55
_TILE = 0.6


def build_services(plan: Plan, stages: int, rng: np.random.Generator) -> list[Element]:
    """Services from the second stage on; dropped ceilings in part of the floor at the third."""
    if stages < 2:
        return []
    second = stages_from(2, stages)
    third = stages_from(3, stages)
    below_beams = plan.height - BEAM_DEPTH
    elements = [Element("duct", second, _corridor_duct(plan, below_beams, rng))]
    elements.append(Element("cable_tray", second, _tray(plan, below_beams, rng)))
    for room in plan.rooms:
        stages_here = second if rng.random() < 0.6 else third
        elements.append(Element("pipe", stages_here, _branch_pipes(plan, room, below_beams, rng)))
        if rng.random() < 0.6:
            duct = _branch_duct(plan, room, below_beams, rng)
            elements.append(Element("duct", second if rng.random() < 0.6 else third, duct))
    if stages >= 3:
        hidden = [room for room in plan.rooms if rng.random() < 0.45]
        elements += [
            Element("dropped_ceiling", third, _ceiling(room, rng))
            for room in [*hidden, _corridor_half(plan)]
        ]
    return [element for element in elements if element.stages]


def _corridor_duct(plan: Plan, top: float, rng: np.random.Generator) -> Mesh:
    corridor = plan.corridor
    width = rng.uniform(0.45, 0.6)
    y = corridor.y0 + 0.15
    end = plan.width * rng.uniform(0.7, 0.9)
    bottom = top - 0.3
    pieces = [box((0.3, y, bottom), (end, y + width, top - 0.02))]
    for x in np.arange(1.0, end, 1.8):
        for edge in (y - 0.02, y + width):
            pieces.append(box((x, edge, bottom - 0.03), (x + 0.03, edge + 0.02, plan.height)))
        pieces.append(box((x, y - 0.02, bottom - 0.03), (x + 0.03, y + width + 0.02, bottom)))
    return merge(pieces)


def _tray(plan: Plan, top: float, rng: np.random.Generator) -> Mesh:
    y = plan.corridor.y1 - rng.uniform(0.35, 0.5)
    z = top - rng.uniform(0.1, 0.2)
    pieces = [box((0.3, y, z), (plan.width - 0.3, y + 0.25, z + 0.015))]
    for edge in (y, y + 0.24):
        pieces.append(box((0.3, edge, z), (plan.width - 0.3, edge + 0.01, z + 0.06)))
    for x in np.arange(0.8, plan.width - 0.5, 1.5):
        pieces.append(box((x, y + 0.11, z), (x + 0.03, y + 0.14, plan.height)))
    return merge(pieces)


def _branch_pipes(plan: Plan, room: Rectangle, top: float, rng: np.random.Generator) -> Mesh:
    """Parallel pipes from the corridor into a room, a sprinkler line with drops among them."""
    x = rng.uniform(room.x0 + 0.5, room.x1 - 0.8)
    corridor_y = (plan.corridor.y0 + plan.corridor.y1) / 2
    far = room.y1 - 0.4 if room.y0 >= corridor_y else room.y0 + 0.4
    z = top - rng.uniform(0.08, 0.25)
    pieces = [
        cylinder((x + gap, corridor_y, z), (x + gap, far, z), radius)
        for gap, radius in zip((0.0, 0.14, 0.3), rng.uniform(0.02, 0.055, 3), strict=True)
    ]
    along = rng.uniform(0.3, 0.8)
    y = corridor_y + (far - corridor_y) * along
    pieces.append(cylinder((room.x0 + 0.3, y, z), (room.x1 - 0.3, y, z), 0.03))
    for drop in np.arange(room.x0 + 0.8, room.x1 - 0.4, rng.uniform(1.6, 2.6)):
        pieces.append(cylinder((drop, y, z), (drop, y, z - 0.18), 0.02))
        pieces.append(cylinder((drop, y, z), (drop, y, plan.height), 0.015))
    return merge(pieces)


def _branch_duct(plan: Plan, room: Rectangle, top: float, rng: np.random.Generator) -> Mesh:
    """A rectangular or spiral duct along a room, with an outlet box at its end."""
    y = rng.uniform(room.y0 + 0.8, room.y1 - 1.0)
    z = top - 0.22
    x0, x1 = room.x0 + rng.uniform(0.2, 0.6), room.x1 - rng.uniform(0.4, 1.2)
    if rng.random() < 0.5:
        body = box((x0, y - 0.2, z - 0.12), (x1, y + 0.2, z + 0.12))
    else:
        body = cylinder((x0, y, z), (x1, y, z), rng.uniform(0.1, 0.17), sides=16)
    outlet = box((x1 - 0.45, y - 0.25, z - 0.3), (x1 + 0.05, y + 0.25, z + 0.05))
    hangers = [
        box((x, y - 0.01, z), (x + 0.02, y + 0.01, plan.height)) for x in np.arange(x0, x1, 1.5)
    ]
    return merge([body, outlet, *hangers])


def _corridor_half(plan: Plan) -> Rectangle:
    corridor = plan.corridor
    return Rectangle(corridor.x0, corridor.y0, plan.width / 2, corridor.y1)


def _ceiling(room: Rectangle, rng: np.random.Generator) -> Mesh:
    """Tiles in a visible grid; some are not yet in."""
    z = _CEILING_HEIGHT
    pieces = []
    for x in np.arange(room.x0, room.x1, _TILE):
        pieces.append(box((x, room.y0, z - 0.03), (x + 0.025, room.y1, z)))
        for y in np.arange(room.y0, room.y1, _TILE):
            if rng.random() < 0.85:
                x1, y1 = min(x + _TILE, room.x1), min(y + _TILE, room.y1)
                pieces.append(box((x, y, z), (x1, y1, z + 0.015)))
    for y in np.arange(room.y0, room.y1, _TILE):
        pieces.append(box((room.x0, y, z - 0.03), (room.x1, y + 0.025, z)))
    return merge(pieces)
