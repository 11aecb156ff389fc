"""Ducts, pipes, sprinkler lines and cable trays on their hangers under the ceiling slab."""

from __future__ import annotations

import numpy as np

from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.mesh import Mesh, boxes, cylinders, merge
from nss_ros.simulation.procedural.layout import Room, RoomKind
from nss_ros.simulation.procedural.plan import Plan
from nss_ros.simulation.procedural.programme import DUCTS, PIPES, TRAYS, Programme

_HANGER_SPACING = 1.5
_SPRINKLER_SPACING = 3.0
_WET = {RoomKind.BATH, RoomKind.HALL}
_Part = tuple[str, str, float, Mesh, Material]


def build_services(
    plan: Plan, rooms: list[Room], programme: Programme, rng: np.random.Generator
) -> list[Element]:
    """Services of all rooms and corridors, plan coordinates.

    Args:
        plan: of the structure.
        rooms: of a layout.
        programme: of the works.
        rng: of sizes, places and delays.
    """
    # Runs through a corridor keep their place from bay to bay, and branches theirs from room
    # to room: the sizes are drawn once per floor.
    sizes = _Sizes(rng)
    elements = []
    for room in rooms:
        if room.kind is RoomKind.CORRIDOR:
            parts = _corridor(plan, room, sizes)
        elif room.kind is RoomKind.LOBBY:
            parts = []
        elif room.kind in _WET:
            parts = _wet(plan, room, rng)
        else:
            parts = _branches(plan, room, sizes, rng)
        delay = float(rng.normal(0.0, 0.35))
        for kind, label, start, mesh, material in parts:
            stages = programme.during(room.zone, start + delay)
            if stages:
                elements.append(Element(kind, stages, mesh, material, f"{room.name}, {label}"))
    return elements


class _Sizes:
    """Of all ducts and pipes of a floor, metres."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.duct = float(rng.uniform(0.45, 0.65)), float(rng.uniform(0.24, 0.3))
        self.branch = float(rng.uniform(0.1, 0.15))
        self.round = bool(rng.random() < 0.5)
        self.pipes = rng.uniform(0.02, 0.05, 4)
        self.tray = float(rng.choice([0.2, 0.3, 0.4]))
        self.line = float(rng.uniform(0.35, 0.65))


def _corridor(plan: Plan, room: Room, sizes: _Sizes) -> list[_Part]:
    """The main duct on one side, the tray on the other, pipes between."""
    area, top = room.area, plan.below_beams
    width, depth = sizes.duct
    y = area.y0 + 0.2
    duct = boxes((area.x0, y, top - depth - 0.02), (area.x1, y + width, top - 0.02))
    hung = _hangers(area.x0, area.x1, (y - 0.02, y + width), top - depth - 0.02, plan.height)
    flanges = np.arange(area.x0 + 0.3, area.x1, 1.2)
    joints = boxes(
        [(x, y - 0.02, top - depth - 0.04) for x in flanges],
        [(x + 0.03, y + width + 0.02, top) for x in flanges],
    )
    tray_y = area.y1 - 0.2 - sizes.tray
    z = top - 0.18
    sheet = boxes(
        [(area.x0, tray_y, z), (area.x0, tray_y, z), (area.x0, tray_y + sizes.tray - 0.01, z)],
        [
            (area.x1, tray_y + sizes.tray, z + 0.015),
            (area.x1, tray_y + 0.01, z + 0.06),
            (area.x1, tray_y + sizes.tray, z + 0.06),
        ],
    )
    tray = merge([sheet, _hangers(area.x0, area.x1, (tray_y, tray_y + sizes.tray), z, plan.height)])
    gap = y + width + 0.12 + 0.13 * np.arange(3)
    pipes = [
        cylinders((area.x0, py, top - 0.12), (area.x1, py, top - 0.12), radius)
        for py, radius in zip(gap, sizes.pipes[:3], strict=True)
        if py < tray_y - 0.06
    ]
    return [
        ("duct", "main duct", DUCTS, merge([duct, hung, joints]), Material.METAL),
        ("pipe", "pipes", PIPES, merge(pipes), Material.METAL),
        ("cable_tray", "cable tray", TRAYS, tray, Material.METAL),
    ]


def _hangers(x0: float, x1: float, sides: tuple[float, float], bottom: float, top: float) -> Mesh:
    """Rods on both sides and a rail below."""
    x = np.arange(x0 + 0.5, x1, _HANGER_SPACING)
    rods = [(a, b) for a in x for b in sides]
    lower = [(a, b - 0.008, bottom - 0.03) for a, b in rods]
    upper = [(a + 0.016, b + 0.008, top) for a, b in rods]
    lower += [(a - 0.01, sides[0] - 0.02, bottom - 0.03) for a in x]
    upper += [(a + 0.03, sides[1] + 0.02, bottom) for a in x]
    return boxes(lower, upper)


def _branches(plan: Plan, room: Room, sizes: _Sizes, rng: np.random.Generator) -> list[_Part]:
    """Sprinkler lines with their heads, and a duct with an outlet in from the corridor."""
    parts = [("sprinkler", "sprinkler line", PIPES, _sprinklers(plan, room, sizes), Material.METAL)]
    area = room.area
    count = 1 if room.kind is not RoomKind.OPEN else max(1, round((area.x1 - area.x0) / 3.5))
    ducts = [_branch(plan, room, sizes, (k + 0.5) / count, rng) for k in range(count)]
    parts.append(("duct", "branch duct", DUCTS + 0.5, merge(ducts), Material.METAL))
    if room.kind in {RoomKind.LAB, RoomKind.SERVICE}:
        parts.append(("pipe", "pipes", PIPES + 0.4, _wall_pipes(plan, room, sizes), Material.METAL))
    return parts


def _sprinklers(plan: Plan, room: Room, sizes: _Sizes) -> Mesh:
    area, z = room.area, plan.below_beams - 0.1
    depth = area.y1 - area.y0
    lines = max(1, round(depth / _SPRINKLER_SPACING))
    ys = area.y0 + depth * (np.arange(lines) + sizes.line) / lines
    heads = max(1, round((area.x1 - area.x0) / _SPRINKLER_SPACING))
    xs = area.x0 + (area.x1 - area.x0) * (np.arange(heads) + 0.5) / heads
    runs = cylinders([(area.x0, y, z) for y in ys], [(area.x1, y, z) for y in ys], 0.022, sides=8)
    points = [(x, y) for x in xs for y in ys]
    drops = cylinders(
        [(x, y, plan.ceiling_height - 0.03) for x, y in points],
        [(x, y, plan.height) for x, y in points],
        0.014,
        sides=6,
    )
    return merge([runs, drops])


def _branch(plan: Plan, room: Room, sizes: _Sizes, share: float, rng: np.random.Generator) -> Mesh:
    area, z = room.area, plan.below_beams - 0.2
    x = area.x0 + (area.x1 - area.x0) * (1 - share if room.mirrored else share)
    inward = 1.0 if room.corridor_y == area.y0 else -1.0
    start = room.corridor_y + inward * 0.1
    end = room.corridor_y + inward * 0.68 * (area.y1 - area.y0)
    low, high = sorted((start, end))
    radius = sizes.branch
    if sizes.round:
        body = cylinders((x, low, z), (x, high, z), radius, sides=14)
    else:
        body = boxes((x - radius * 1.3, low, z - radius), (x + radius * 1.3, high, z + radius))
    wobble = rng.normal(0.0, 0.03)
    outlet = boxes(
        (x - 0.25, end - 0.25 + wobble, plan.ceiling_height),
        (x + 0.25, end + 0.25 + wobble, z + 0.05),
    )
    rods = np.arange(low + 0.4, high, _HANGER_SPACING)
    hangers = boxes(
        [(x - 0.008, y - 0.008, z) for y in rods],
        [(x + 0.008, y + 0.008, plan.height) for y in rods],
    )
    return merge([body, outlet, hangers])


def _wall_pipes(plan: Plan, room: Room, sizes: _Sizes) -> Mesh:
    """Pipes along one side wall, two of them down to the floor."""
    area, z = room.area, plan.below_beams - 0.25
    x = area.x1 - 0.3 if room.mirrored else area.x0 + 0.3
    offsets = 0.12 * np.arange(len(sizes.pipes)) * (-1 if room.mirrored else 1)
    low, high = area.y0 + 0.2, area.y1 - 0.3
    runs = cylinders(
        [(x + o, low, z) for o in offsets], [(x + o, high, z) for o in offsets], sizes.pipes
    )
    risers = cylinders(
        [(x + o, low + 0.3, 0.0) for o in offsets[:2]],
        [(x + o, low + 0.3, z) for o in offsets[:2]],
        sizes.pipes[:2],
    )
    return merge([runs, risers])


def _wet(plan: Plan, room: Room, rng: np.random.Generator) -> list[_Part]:
    """Bathrooms: stacks in a corner and stubs along the wall; halls: a small duct."""
    area = room.area
    if room.kind is RoomKind.HALL:
        y = (area.y0 + area.y1) / 2
        z = plan.below_beams - 0.15
        duct = cylinders((area.x0 + 0.2, y, z), (area.x1 - 0.2, y, z), 0.08)
        return [("duct", "duct", DUCTS + 0.6, duct, Material.METAL)]
    x = area.x0 + 0.2 if room.mirrored else area.x1 - 0.2
    inner = area.y0 if room.corridor_y == area.y1 else area.y1
    y = inner + (0.2 if inner == area.y0 else -0.2)
    step = 0.14 if inner == area.y0 else -0.14
    stacks = cylinders(
        [(x, y + step * k, 0.0) for k in range(3)],
        [(x, y + step * k, plan.height) for k in range(3)],
        [0.055, 0.03, 0.02],
    )
    z = 0.35 + rng.normal(0.0, 0.02)
    low, high = area.y0 + 0.25, area.y1 - 0.25
    stubs = cylinders([(x, low, z), (x, low, z + 0.1)], [(x, high, z), (x, high, z + 0.1)], 0.014)
    return [("pipe", "stack and supply", PIPES, merge([stacks, stubs]), Material.METAL)]
