"""Furniture that comes at the end, laid out alike in alike rooms.

Pieces are made around the z axis with their back towards -y. A room is furnished in its own
frame: u across it from the side where its door is, v from the corridor towards the facade.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.mesh import (
    Mesh,
    boxes,
    cylinders,
    merge,
    moved,
    standing_box,
)
from nss_ros.simulation.procedural.layout import Room, RoomKind

_MARGIN = 0.05
_BACK_LEFT, _BACK_RIGHT, _BACK_FACADE = -np.pi / 2, np.pi / 2, np.pi


@dataclass(frozen=True, slots=True)
class Placed:
    """A piece of furniture and where it stands, plan coordinates.

    Attributes:
        kind: of its element.
        mesh: around the z axis.
        x: of the axis, metres.
        y: of the axis, metres.
        yaw: radians.
    """

    kind: str
    mesh: Mesh
    x: float
    y: float
    yaw: float


def furnish(room: Room, deviation: float, rng: np.random.Generator) -> list[Placed]:
    """The furniture of a room; what does not fit is left out.

    Args:
        room: to be furnished.
        deviation: factor of how far pieces stand out of place.
        rng: of the deviations and of what lies on tables.
    """
    size = np.array([room.area.x1 - room.area.x0, room.area.y1 - room.area.y0])
    make = _FURNITURE.get(room.kind)
    placed = []
    for kind, mesh, u, v, turn in make(float(size[0]), float(size[1]), rng) if make else ():
        half = np.abs(mesh.vertices[:, :2]).max(axis=0)
        if abs(np.sin(turn)) > 0.5:
            half = half[::-1]
        place = np.array([u, v])
        if (place - half > _MARGIN).all() and (place + half < size - _MARGIN).all():
            place += rng.normal(0.0, 0.03 * deviation, 2)
            yaw = turn + rng.normal(0.0, 0.02 * deviation)
            placed.append(_in_plan(room, kind, mesh, place, yaw))
    return placed


_Piece = tuple[str, Mesh, float, float, float]


def _in_plan(room: Room, kind: str, mesh: Mesh, place: np.ndarray, yaw: float) -> Placed:
    area = room.area
    x, y = area.x0 + place[0], area.y0 + place[1]
    if room.mirrored:
        x, yaw = area.x1 - place[0], -yaw
    if room.corridor_y == area.y1:
        y, yaw = area.y1 - place[1], np.pi - yaw
    return Placed(kind, mesh, float(x), float(y), float(yaw))


def _meeting_room(width: float, depth: float, rng: np.random.Generator) -> list[_Piece]:
    return [("table", _meeting(min(width - 2.2, 3.6), rng), width / 2, depth / 2, 0.0)]


def _service_room(width: float, depth: float, rng: np.random.Generator) -> list[_Piece]:
    places = 0.9 + 1.25 * np.arange(int((depth - 0.6) / 1.25))
    return [("shelf", _shelf(rng), width - 0.28, v, _BACK_RIGHT) for v in places.tolist()]


def _living_room(width: float, depth: float, rng: np.random.Generator) -> list[_Piece]:
    return [
        ("kitchen", _kitchen(), 0.38, depth / 2 + 0.4, _BACK_LEFT),
        ("table", _dining(rng), width * 0.6, depth - 1.4, 0.0),
        ("sofa", _sofa(), width - 0.55, 1.5, _BACK_RIGHT),
    ]


def _bedroom(width: float, depth: float, _: np.random.Generator) -> list[_Piece]:
    return [
        ("bed", _bed(1.6), width / 2, depth - 1.15, _BACK_FACADE),
        ("cabinet", _cabinet(1.6, 2.1, 0.6), width - 0.38, 1.2, _BACK_RIGHT),
    ]


def _ward(width: float, depth: float, _: np.random.Generator) -> list[_Piece]:
    middle = depth * 0.45
    return [
        ("bed", _bed(0.95), width - 1.15, middle, _BACK_RIGHT),
        ("cabinet", _cabinet(0.5, 0.8, 0.45), width - 0.3, middle + 0.85, _BACK_RIGHT),
        ("cabinet", _cabinet(0.9, 2.0, 0.55), width - 0.35, 0.65, _BACK_RIGHT),
        ("chair", _chair(), 0.8, depth - 0.8, _BACK_FACADE),
    ]


def _office(width: float, depth: float, rng: np.random.Generator) -> list[_Piece]:
    return [
        ("desk", _desk(1.6, rng), width / 2, depth - 1.1, 0.0),
        ("desk", _desk(1.6, rng), width / 2, depth - 2.75, np.pi),
        ("cabinet", _cabinet(1.0, 1.95, 0.42), width - 0.3, 0.8, _BACK_RIGHT),
        ("cabinet", _cabinet(1.0, 1.15, 0.42), width - 0.3, 1.85, _BACK_RIGHT),
    ]


def _open_plan(width: float, depth: float, rng: np.random.Generator) -> list[_Piece]:
    """Clusters of four desks at a regular pitch, cabinets between them."""
    pieces: list[_Piece] = []
    for u in np.arange(2.0, width - 1.2, 3.6):
        for v in np.arange(2.2, depth - 1.2, 4.2):
            for du, dv, turn in (
                (-0.8, 0.42, 0),
                (0.8, 0.42, 0),
                (-0.8, -0.42, 1),
                (0.8, -0.42, 1),
            ):
                desk = _desk(1.58, rng)
                pieces.append(("desk", desk, u + du, v + dv, np.pi * turn))
        pieces.append(("cabinet", _cabinet(1.6, 1.15, 0.42), u, 0.45, 0.0))
    return pieces


def _laboratory(width: float, depth: float, rng: np.random.Generator) -> list[_Piece]:
    """Island benches and fume cupboards along one side."""
    length = depth - 2.6
    pieces: list[_Piece] = [
        ("bench", _bench(length, rng), u, depth / 2 + 0.3, _BACK_LEFT)
        for u in np.arange(2.0, width - 1.2, 2.9)
    ]
    pieces += [
        ("fume_cupboard", _cabinet(1.5, 2.35, 0.75), width - 0.5, v, _BACK_RIGHT)
        for v in np.arange(1.3, depth - 1.0, 1.7)
    ]
    return pieces


def _desk(length: float, rng: np.random.Generator) -> Mesh:
    """A desk, its user's chair on the +y side, mostly with a screen."""
    legs = [(x, y) for x in (-length / 2 + 0.06, length / 2 - 0.06) for y in (-0.34, 0.34)]
    lower = [(-length / 2, -0.4, 0.71), *((x - 0.03, y - 0.03, 0.0) for x, y in legs)]
    upper = [(length / 2, 0.4, 0.74), *((x + 0.03, y + 0.03, 0.71) for x, y in legs)]
    if rng.random() < 0.7:
        x = rng.uniform(-0.25, 0.25)
        lower += [(x - 0.28, -0.2, 0.85), (x - 0.03, -0.2, 0.74)]
        upper += [(x + 0.28, -0.17, 1.2), (x + 0.03, -0.16, 0.9)]
    chair = moved(_chair(), from_yaw(rng.normal(np.pi, 0.5), (rng.normal(0.0, 0.1), 0.65, 0.0)))
    return merge([boxes(lower, upper), chair])


def _chair() -> Mesh:
    """An office chair on five feet."""
    angles = np.arange(5) * (2 * np.pi / 5)
    feet = np.stack((0.28 * np.cos(angles), 0.28 * np.sin(angles), np.full(5, 0.03)), axis=1)
    return merge(
        [
            cylinders([(0.0, 0.0, 0.06)], feet, 0.03, sides=6),
            cylinders((0, 0, 0.05), (0, 0, 0.46), 0.03, sides=8),
            boxes(
                [(-0.23, -0.23, 0.46), (-0.21, -0.25, 0.61)],
                [(0.23, 0.23, 0.53), (0.21, -0.2, 1.06)],
            ),
        ]
    )


def _simple_chair() -> Mesh:
    legs = [(x, y) for x in (-0.18, 0.18) for y in (-0.18, 0.18)]
    return boxes(
        [(-0.21, -0.21, 0.44), (-0.21, -0.22, 0.6), *((x - 0.02, y - 0.02, 0.0) for x, y in legs)],
        [(0.21, 0.21, 0.47), (0.21, -0.19, 0.9), *((x + 0.02, y + 0.02, 0.44) for x, y in legs)],
    )


def _cabinet(length: float, height: float, depth: float) -> Mesh:
    """A body on a plinth with the gaps between its doors."""
    body = standing_box(length, depth, 0.08, height)
    plinth = standing_box(length - 0.06, depth - 0.08, 0.0, 0.08)
    doors = np.linspace(-length / 2, length / 2, max(2, round(length / 0.5) + 1))
    fronts = boxes(
        [(x + 0.005, depth / 2, 0.1) for x in doors[:-1]],
        [(x - 0.005, depth / 2 + 0.02, height - 0.02) for x in doors[1:]],
    )
    return merge([body, plinth, fronts])


def _shelf(rng: np.random.Generator) -> Mesh:
    length, height = 1.2, 2.0
    levels = np.arange(0.1, height, 0.45)
    lower = [(-length / 2, -0.2, z) for z in levels] + [(x, -0.2, 0.0) for x in (-0.62, 0.58)]
    upper = [(length / 2, 0.2, z + 0.03) for z in levels] + [
        (x, 0.2, height) for x in (-0.58, 0.62)
    ]
    for z in levels[:-1]:
        x, size, rise = rng.uniform(-0.35, 0.35), rng.uniform(0.15, 0.45), rng.uniform(0.15, 0.35)
        lower.append((x - size / 2, -0.15, z + 0.03))
        upper.append((x + size / 2, 0.15, z + rise))
    return boxes(lower, upper)


def _around(top: Mesh, length: float, width: float, pitch: float, rng: np.random.Generator) -> Mesh:
    """A table with chairs on its two long sides."""
    count = max(1, int(length / pitch))
    chairs = []
    for k in range(count):
        x = (k + 0.5) * length / count - length / 2
        for side in (-1, 1):
            yaw = (0.0 if side < 0 else np.pi) + rng.normal(0.0, 0.15)
            place = (x + rng.normal(0.0, 0.05), side * (width / 2 + 0.2), 0.0)
            chairs.append(moved(_simple_chair(), from_yaw(yaw, place)))
    return merge([top, *chairs])


def _meeting(length: float, rng: np.random.Generator) -> Mesh:
    length = max(length, 1.6)
    lower = [
        (-length / 2, -0.6, 0.71),
        (-length / 2 + 0.3, -0.3, 0.0),
        (length / 2 - 0.4, -0.3, 0.0),
    ]
    upper = [(length / 2, 0.6, 0.75), (-length / 2 + 0.4, 0.3, 0.71), (length / 2 - 0.3, 0.3, 0.71)]
    return _around(boxes(lower, upper), length, 1.2, 0.75, rng)


def _dining(rng: np.random.Generator) -> Mesh:
    legs = [(x, y) for x in (-0.64, 0.64) for y in (-0.36, 0.36)]
    lower = [(-0.7, -0.42, 0.72), *((x - 0.03, y - 0.03, 0.0) for x, y in legs)]
    upper = [(0.7, 0.42, 0.75), *((x + 0.03, y + 0.03, 0.72) for x, y in legs)]
    return _around(boxes(lower, upper), 1.4, 0.84, 0.65, rng)


def _kitchen() -> Mesh:
    """Base units with a worktop, wall units and a tall unit."""
    units = np.arange(4) * 0.6 - 1.2
    return boxes(
        [
            (-1.2, -0.3, 0.0),
            (-1.2, -0.3, 0.87),
            (1.2, -0.3, 0.0),
            *((x, -0.3, 1.45) for x in units),
        ],
        [
            (1.2, 0.26, 0.87),
            (1.2, 0.32, 0.91),
            (1.8, 0.3, 2.1),
            *((x + 0.59, 0.05, 2.1) for x in units),
        ],
    )


def _sofa() -> Mesh:
    return boxes(
        [(-1.0, -0.45, 0.08), (-1.0, -0.45, 0.42), (-1.0, -0.45, 0.42), (0.82, -0.45, 0.42)],
        [(1.0, 0.45, 0.42), (1.0, -0.2, 0.82), (-0.82, 0.45, 0.6), (1.0, 0.45, 0.6)],
    )


def _bed(width: float) -> Mesh:
    """Its head at the back."""
    half = width / 2
    return boxes(
        [(-half, -1.0, 0.25), (-half, -1.05, 0.0), (-half, 1.0, 0.0), (-half + 0.1, -0.95, 0.5)],
        [(half, 1.0, 0.5), (half, -1.0, 1.0), (half, 1.05, 0.6), (half - 0.1, -0.55, 0.6)],
    )


def _bench(length: float, rng: np.random.Generator) -> Mesh:
    """A double bench with a reagent shelf along its middle; its length along x."""
    half = length / 2
    units = np.arange(-half + 0.05, half - 0.9, 1.0)
    lower = [(-half, -0.75, 0.87), *((x, -0.7, 0.05) for x in units)]
    upper = [(half, 0.75, 0.9), *((x + 0.9, 0.7, 0.87) for x in units)]
    for z in (1.2, 1.55):
        lower.append((-half + 0.2, -0.15, z))
        upper.append((half - 0.2, 0.15, z + 0.03))
    posts = np.linspace(-half + 0.2, half - 0.24, 4)
    lower += [(x, -0.15, 0.9) for x in posts]
    upper += [(x + 0.04, 0.15, 1.6) for x in posts]
    for _ in range(int(rng.integers(1, 5))):
        x, side = rng.uniform(-half + 0.3, half - 0.3), rng.choice([-0.5, 0.5])
        size = rng.uniform(0.12, 0.3, 3)
        lower.append((x - size[0], side - size[1] / 2, 0.9))
        upper.append((x + size[0], side + size[1] / 2, 0.9 + size[2]))
    return boxes(lower, upper)


def _bathroom(width: float, depth: float, _: np.random.Generator) -> list[_Piece]:
    toilet = boxes(
        [(-0.18, -0.3, 0.0), (-0.2, -0.35, 0.4), (-0.25, -0.35, 0.0)],
        [(0.18, 0.3, 0.4), (0.2, 0.3, 0.44), (0.25, -0.22, 1.1)],
    )
    basin = boxes([(-0.3, -0.22, 0.78), (-0.06, -0.2, 0.0)], [(0.3, 0.25, 0.88), (0.06, 0.0, 0.78)])
    shower = boxes(
        [(-0.45, -0.45, 0.0), (-0.45, -0.45, 0.0)], [(0.45, 0.45, 0.05), (-0.43, 0.45, 2.0)]
    )
    return [
        ("toilet", toilet, width - 0.42, depth * 0.3, _BACK_RIGHT),
        ("basin", basin, width - 0.3, depth * 0.72, _BACK_RIGHT),
        ("shower", shower, 0.52, depth - 0.55, 0.0),
    ]


_FURNITURE = {
    RoomKind.CELL: _office,
    RoomKind.OPEN: _open_plan,
    RoomKind.LAB: _laboratory,
    RoomKind.MEETING: _meeting_room,
    RoomKind.SERVICE: _service_room,
    RoomKind.LIVING: _living_room,
    RoomKind.BEDROOM: _bedroom,
    RoomKind.BATH: _bathroom,
    RoomKind.WARD: _ward,
}
