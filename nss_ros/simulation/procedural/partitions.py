"""Partitions from chalk line to closed: tracks, studs, boards, blockwork, glass, doors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from nss_ros.geometry import Transform, from_rotation
from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.mesh import Mesh, Opening, boxes, merge, moved, wall
from nss_ros.simulation.procedural.layout import Construction, Wall
from nss_ros.simulation.procedural.programme import (
    CLOSED,
    DOOR_FRAMES,
    DOORS,
    ONE_SIDE,
    STUDS,
    TRACKS,
    Programme,
)

_STUD_DEPTH, _STUD_WIDTH = 0.075, 0.05
_BOARD = 0.025
_BOARD_WIDTH = 1.2
_BLOCK = 0.175
_COURSE = 0.25
_TRACK = 0.04
_FOREVER = float("inf")


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of a wall in the wall's frame, there from `start` to `end` in steps of work."""

    kind: str
    label: str
    start: float
    mesh: Mesh
    material: Material = Material.MATT
    end: float = _FOREVER


def build_partitions(
    walls: list[Wall],
    height: float,
    programme: Programme,
    deviation: float,
    rng: np.random.Generator,
) -> list[Element]:
    """All parts of all partitions, plan coordinates.

    Args:
        walls: of a layout.
        height: of the ceiling slab, metres.
        programme: of the works.
        deviation: factor of the deviations from plan.
        rng: of deviations and delays.
    """
    makers = {
        Construction.STUD: _stud_wall,
        Construction.BLOCK: _block_wall,
        Construction.GLASS: _glass_wall,
    }
    elements = []
    for item in walls:
        pose = item.pose @ _as_built(deviation, rng)
        delay = float(rng.normal(0.0, 0.3))
        parts = makers[item.construction](item, height, rng) + _doors(item, rng)
        for part in parts:
            stages = programme.during(item.zone, part.start + delay, part.end + delay)
            if stages:
                name = f"{item.name}, {part.label}"
                mesh = moved(part.mesh, pose)
                elements.append(Element(part.kind, stages, mesh, part.material, name))
    return elements


def _as_built(deviation: float, rng: np.random.Generator) -> Transform:
    """A little out of place, out of line and out of plumb."""
    lean, turn = rng.normal(0.0, np.radians([0.12, 0.1]) * deviation)
    shift = rng.normal(0.0, 0.008 * deviation)
    return from_rotation(Rotation.from_euler("xz", [lean, turn]), (0.0, shift, 0.0))


def _stud_wall(item: Wall, height: float, rng: np.random.Generator) -> list[_Part]:
    half = _STUD_DEPTH / 2
    foot = [Opening(door.start, door.end, 0.0, _TRACK) for door in item.doors]
    track = wall(item.length, (-half, 0.0), (half, _TRACK), foot)
    head = boxes((0.0, -half, height - _TRACK), (item.length, half, height))
    parts = [
        _Part("track", "bottom track", TRACKS, track, Material.METAL),
        _Part("stud", "studs", STUDS, merge([_studs(item, height, rng), head]), Material.METAL),
    ]
    insulated = rng.random() < 0.5
    if insulated:
        wool = boxes((0.0, -half + 0.01, 0.05), (item.length, half - 0.01, height - 0.05))
        pierced = _pierced(wool, item, -half + 0.01, half - 0.01, height - 0.05)
        parts.append(_Part("insulation", "insulation", ONE_SIDE + 0.4, pierced, Material.MATT))
    sides = [("first", half, ONE_SIDE), ("second", -half - _BOARD, CLOSED)]
    for side, inner, start in sides:
        for part, (low, high) in enumerate(_shares(item.length, rng)):
            board = _board(item, inner, low, high, height)
            late = start + (0.35 if part else 0.0)
            parts.append(_Part("board", f"{side} side boards {part + 1}", late, board))
    return parts


def _pierced(whole: Mesh, item: Wall, near: float, far: float, top: float) -> Mesh:
    """The same layer with its doors left open."""
    return wall(item.length, (near, 0.05), (far, top), item.doors) if item.doors else whole


def _studs(item: Wall, height: float, rng: np.random.Generator) -> Mesh:
    half = _STUD_DEPTH / 2
    spacing = float(rng.choice([0.4, 0.6, 0.6]))
    regular = np.arange(0.0, item.length - _STUD_WIDTH, spacing)
    regular = regular + rng.normal(0.0, 0.008, len(regular))
    jambs = [x for door in item.doors for x in (door.start - _STUD_WIDTH, door.end)]
    x = np.concatenate((regular, jambs, [0.0, item.length - _STUD_WIDTH]))
    bottom = np.zeros(len(x))
    for door in item.doors:
        bottom[(x >= door.start - 1e-9) & (x < door.end - 1e-9)] = door.top
    lower = np.column_stack((x, np.full(len(x), -half), bottom))
    upper = np.column_stack((x + _STUD_WIDTH, np.full(len(x), half), np.full(len(x), height)))
    lintels = [
        boxes((door.start, -half, door.top), (door.end, half, door.top + 0.05))
        for door in item.doors
    ]
    return merge([boxes(lower, upper), *lintels])


def _shares(length: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Boards go up from one end; the rest of a long wall may come later."""
    if length < 2 * _BOARD_WIDTH or rng.random() < 0.5:
        return [(0.0, length)]
    split = _BOARD_WIDTH * int(rng.integers(1, int(length / _BOARD_WIDTH)))
    return [(0.0, split), (split, length)]


def _board(item: Wall, inner: float, low: float, high: float, top: float) -> Mesh:
    openings = [
        Opening(max(door.start, low) - low, min(door.end, high) - low, 0.0, door.top)
        for door in item.doors
        if door.start < high and door.end > low
    ]
    board = wall(high - low, (inner, 0.01), (inner + _BOARD, top), openings)
    return Mesh(board.vertices + np.array([low, 0.0, 0.0]), board.triangles)


def _block_wall(item: Wall, height: float, rng: np.random.Generator) -> list[_Part]:
    """A first course, then half the height, then up to the slab."""
    half = _BLOCK / 2
    breast = _COURSE * int(rng.integers(4, 7))
    levels = [(0.0, _COURSE, TRACKS), (_COURSE, breast, STUDS), (breast, height, ONE_SIDE)]
    labels = ("first course", "lower courses", "upper courses")
    parts = []
    for label, (bottom, top, start) in zip(labels, levels, strict=True):
        courses = wall(item.length, (-half, bottom), (half, top), item.doors)
        parts.append(_Part("blockwork", label, start, courses))
    return parts


def _glass_wall(item: Wall, height: float, rng: np.random.Generator) -> list[_Part]:
    """Frames and panes below a closed strip; its track comes with those of the others."""
    half = 0.04
    strip = height - 2.5
    track = boxes((0.0, -half, 0.0), (item.length, half, 0.03))
    if item.doors:
        foot = [Opening(door.start, door.end, 0.0, 0.03) for door in item.doors]
        track = wall(item.length, (-half, 0.0), (half, 0.03), foot)
    count = max(1, round(item.length / float(rng.choice([1.0, 1.2]))))
    edges = np.linspace(0.0, item.length - 0.05, count + 1)
    openings = [x for door in item.doors for x in (door.start - 0.05, door.end)]
    posts = [x for x in edges if not any(d.start - 0.05 < x < d.end for d in item.doors)]
    x = np.array([*posts, *openings])
    frame = boxes(
        np.column_stack((x, np.full(len(x), -half), np.zeros(len(x)))),
        np.column_stack((x + 0.05, np.full(len(x), half), np.full(len(x), 2.5))),
    )
    panes = wall(item.length, (-0.006, 0.03), (0.006, 2.5), item.doors)
    above = boxes((0.0, -half, 2.5), (item.length, half, 2.5 + strip))
    return [
        _Part("track", "bottom track", TRACKS, track, Material.METAL),
        _Part("board", "strip above", CLOSED, above),
        _Part("glass_frame", "frames", CLOSED + 0.3, frame, Material.METAL),
        _Part("glass_pane", "panes", DOOR_FRAMES + 0.8, panes, Material.GLASS),
    ]


def _doors(item: Wall, rng: np.random.Generator) -> list[_Part]:
    depth = (_BLOCK / 2 if item.construction is Construction.BLOCK else 0.0625) + 0.01
    parts = []
    for number, door in enumerate(item.doors, start=1):
        parts.append(_Part("door_frame", f"door frame {number}", DOOR_FRAMES, _frame(door, depth)))
        parts.append(_Part("door", f"door {number}", DOORS, _leaf(item, door, rng)))
    return parts


def _frame(door: Opening, depth: float) -> Mesh:
    lower = [(door.start, -depth, 0.0), (door.end - 0.04, -depth, 0.0)]
    upper = [(door.start + 0.04, depth, door.top), (door.end, depth, door.top)]
    head = (door.start, -depth, door.top - 0.04), (door.end, depth, door.top)
    return boxes([*lower, head[0]], [*upper, head[1]])


def _leaf(item: Wall, door: Opening, rng: np.random.Generator) -> Mesh:
    """A leaf hung on the jamb next to the corner, left open at some angle."""
    width = door.end - door.start - 0.1
    leaf = boxes((0.0, -0.02, 0.01), (width, 0.02, door.top - 0.05))
    angle = item.swing * rng.uniform(np.radians(70), np.radians(100))
    hinge, turn = door.start + 0.05, angle
    if door.start > item.length - door.end:
        hinge, turn = door.end - 0.05, np.pi - angle
    return moved(leaf, from_rotation(Rotation.from_euler("z", turn), (hinge, 0.0, 0.0)))
