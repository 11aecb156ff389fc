"""Dry-lined walls from bottom track to closed, with their door frames and doors."""

from __future__ import annotations

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Element
from nss_ros.simulation.mesh import Mesh, Opening, box, merge, moved, wall
from nss_ros.simulation.procedural.plan import DOOR_HEIGHT, Partition, Plan

_STUD_DEPTH = 0.075
_STUD_WIDTH = 0.05
_BOARD_THICKNESS = 0.025
_BOARD_WIDTH = 1.2
_TRACK, _STUDS, _ONE_SIDE, _CLOSED = 1, 2, 3, 4


def build_partitions(plan: Plan, rng: np.random.Generator) -> list[Element]:
    """The parts of all partitions, each from the stage on at which it is built."""
    elements = []
    for partition in plan.partitions:
        for kind, state, mesh in _parts(partition, plan.height, rng):
            stages = frozenset(
                stage
                for stage, progress in enumerate(partition.progress, start=1)
                if progress >= state
            )
            if stages:
                elements.append(Element(kind, stages, moved(mesh, partition.pose)))
    return elements


def _parts(
    partition: Partition, height: float, rng: np.random.Generator
) -> list[tuple[str, int, Mesh]]:
    """Kind, state from which it is there, and mesh in the wall frame."""
    half = _STUD_DEPTH / 2
    parts = [
        ("track", _TRACK, _track(partition, half)),
        ("stud", _STUDS, _studs(partition, half, height, rng)),
    ]
    top = height if rng.random() < 0.6 else 2.75
    for state, inner in ((_ONE_SIDE, half), (_CLOSED, -half - _BOARD_THICKNESS)):
        for board in _boards(partition, inner, top):
            late = state == _ONE_SIDE and rng.random() < 0.2
            parts.append(("board", state + late, board))
    for door in partition.doors:
        parts.append(("door_frame", _ONE_SIDE, _door_frame(door)))
        if door.end - door.start < 1.5:
            parts.append(("door", _CLOSED, _door_leaf(door, rng)))
    return parts


def _track(partition: Partition, half: float) -> Mesh:
    floor_openings = [Opening(d.start, d.end, 0.0, 0.04) for d in partition.doors]
    return wall(partition.length, (-half, 0.0), (half, 0.04), floor_openings)


def _studs(partition: Partition, half: float, height: float, rng: np.random.Generator) -> Mesh:
    spacing = float(rng.choice([0.4, 0.6, 0.6]))
    positions = np.arange(0.0, partition.length - _STUD_WIDTH, spacing)
    positions = positions + rng.normal(0.0, 0.01, len(positions))
    jambs = [x for d in partition.doors for x in (d.start - _STUD_WIDTH, d.end)]
    ends = [0.0, partition.length - _STUD_WIDTH]
    pieces = []
    for x in (*positions, *jambs, *ends):
        bottom = 0.0
        for door in partition.doors:
            if door.start - 1e-9 <= x < door.end - 1e-9:
                bottom = door.top
        pieces.append(box((x, -half, bottom), (x + _STUD_WIDTH, half, height)))
    pieces.append(box((0.0, -half, height - 0.04), (partition.length, half, height)))
    pieces += [box((d.start, -half, d.top), (d.end, half, d.top + 0.05)) for d in partition.doors]
    return merge(pieces)


def _boards(partition: Partition, inner: float, top: float) -> list[Mesh]:
    boards = []
    for start in np.arange(0.0, partition.length, _BOARD_WIDTH):
        end = min(start + _BOARD_WIDTH, partition.length)
        openings = [
            Opening(max(d.start, start) - start, min(d.end, end) - start, 0.0, DOOR_HEIGHT)
            for d in partition.doors
            if d.start < end and d.end > start
        ]
        board = wall(end - start, (inner, 0.01), (inner + _BOARD_THICKNESS, top), openings)
        boards.append(moved(board, from_yaw(0.0, (start, 0.0, 0.0))))
    return boards


def _door_frame(door: Opening) -> Mesh:
    depth = _STUD_DEPTH / 2 + _BOARD_THICKNESS + 0.01
    return merge(
        [
            box((door.start, -depth, 0.0), (door.start + 0.04, depth, door.top)),
            box((door.end - 0.04, -depth, 0.0), (door.end, depth, door.top)),
            box((door.start, -depth, door.top - 0.04), (door.end, depth, door.top)),
        ]
    )


def _door_leaf(door: Opening, rng: np.random.Generator) -> Mesh:
    """A leaf hung on one jamb and left open at some angle, as doors on a site are."""
    width = door.end - door.start - 0.1
    leaf = box((0.0, -0.02, 0.01), (width, 0.02, door.top - 0.05))
    angle = rng.uniform(np.radians(60), np.radians(110)) * rng.choice([-1, 1])
    if rng.random() < 0.5:
        return moved(leaf, from_yaw(angle, (door.start + 0.05, 0.0, 0.0)))
    return moved(leaf, from_yaw(np.pi - angle, (door.end - 0.05, 0.0, 0.0)))
