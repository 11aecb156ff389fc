"""Things that lie about on a site and move between stages.

Each thing is made around the z axis, standing on the floor, and then put somewhere in a room
where it stands neither in a wall nor in the swing of a door nor in another thing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Element, stages_from
from nss_ros.simulation.mesh import Mesh, box, cylinder, merge, mound, moved, standing_box
from nss_ros.simulation.procedural.plan import Plan
from nss_ros.simulation.site import Rectangle

_AREA_PER_THING = 3.2
_DOOR_CLEARANCE = 0.95
_TRIES = 60
_STAYS = 0.25


@dataclass(frozen=True, slots=True)
class _Thing:
    make: Callable[[np.random.Generator], Mesh]
    kind: str
    against_wall: bool
    weights: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Disc:
    x: float
    y: float
    radius: float


def build_clutter(plan: Plan, stages: int, rng: np.random.Generator) -> list[Element]:
    """Random things per stage, some of which stay where they are for two stages."""
    elements = _props(plan, rng)
    fixed = _no_go(plan)
    staying: list[tuple[Element, _Disc]] = []
    for stage in range(1, stages + 1):
        taken = [*fixed, *(disc for _, disc in staying)]
        placed = []
        for room in (*plan.rooms, plan.corridor):
            for _ in range(round(room.area / _AREA_PER_THING)):
                thing = _draw(stage, rng)
                spot = _place(thing, plan, room, taken, rng)
                if spot is None:
                    continue
                mesh, disc = spot
                last = stage + 1 if stage < stages and rng.random() < _STAYS else stage
                placed.append((Element(thing.kind, stages_from(stage, last), mesh), disc))
                taken.append(disc)
        staying = [(element, disc) for element, disc in placed if stage + 1 in element.stages]
        elements += [element for element, _ in placed]
    return elements


def _props(plan: Plan, rng: np.random.Generator) -> list[Element]:
    """Shoring under a part of the slab that was just poured."""
    room = plan.rooms[int(rng.integers(len(plan.rooms)))]
    return [
        Element(
            "prop",
            stages_from(1, 1),
            merge(
                [
                    cylinder((x, y, 0.0), (x, y, plan.height), 0.035),
                    box((x - 0.08, y - 0.08, 0.0), (x + 0.08, y + 0.08, 0.01)),
                ]
            ),
        )
        for x in np.arange(room.x0 + 0.7, room.x1 - 0.4, 1.3) + rng.normal(0.0, 0.05)
        for y in np.arange(room.y0 + 0.8, room.y1 - 0.4, 1.4) + rng.normal(0.0, 0.05)
    ]


def _no_go(plan: Plan) -> list[_Disc]:
    """Doors of partitions and core, kept free."""
    core = plan.core
    discs = [_Disc(core.x0 + x, core.y0, _DOOR_CLEARANCE) for x in (0.95, 2.6)]
    for partition in plan.partitions:
        for door in partition.doors:
            share = (door.start + door.end) / 2 / partition.length
            x, y = np.asarray(partition.start) * (1 - share) + np.asarray(partition.end) * share
            discs.append(_Disc(float(x), float(y), _DOOR_CLEARANCE))
    return discs


def _draw(stage: int, rng: np.random.Generator) -> _Thing:
    weights = np.array([thing.weights[min(stage, 3) - 1] for thing in _THINGS])
    return _THINGS[int(rng.choice(len(_THINGS), p=weights / weights.sum()))]


def _place(
    thing: _Thing,
    plan: Plan,
    room: Rectangle,
    taken: list[_Disc],
    rng: np.random.Generator,
) -> tuple[Mesh, _Disc] | None:
    shape = thing.make(rng)
    half = np.abs(shape.vertices[:, :2]).max(axis=0)
    narrow = room == plan.corridor
    for _ in range(_TRIES):
        yaw, x, y = _position(room, half, thing.against_wall or narrow, rng)
        extent = _extent(half, yaw)
        if narrow and min(extent) > 0.4:
            continue
        disc = _Disc(x, y, float(np.hypot(*half)) * 0.9)
        if _fits(disc, extent, plan, room) and not any(_touch(disc, other) for other in taken):
            return moved(shape, from_yaw(yaw, (x, y, 0.0))), disc
    return None


def _position(
    room: Rectangle, half: np.ndarray, against_wall: bool, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Yaw, x and y: along one of the four sides of the room, or anywhere."""
    gap = rng.uniform(0.12, 0.25)
    if not against_wall:
        yaw = rng.uniform(-np.pi, np.pi)
        return yaw, rng.uniform(room.x0, room.x1), rng.uniform(room.y0, room.y1)
    wobble = rng.normal(0.0, np.radians(3.0))
    side = int(rng.integers(4))
    if side < 2:
        y = room.y0 + half[1] + gap if side == 0 else room.y1 - half[1] - gap
        return side * np.pi + wobble, rng.uniform(room.x0, room.x1), float(y)
    x = room.x0 + half[1] + gap if side == 2 else room.x1 - half[1] - gap
    yaw = (-np.pi / 2 if side == 2 else np.pi / 2) + wobble
    return yaw, float(x), rng.uniform(room.y0, room.y1)


def _extent(half: np.ndarray, yaw: float) -> np.ndarray:
    cosine, sine = abs(np.cos(yaw)), abs(np.sin(yaw))
    return np.array([cosine * half[0] + sine * half[1], sine * half[0] + cosine * half[1]])


def _fits(disc: _Disc, extent: np.ndarray, plan: Plan, room: Rectangle) -> bool:
    """Inside the room, clear of its walls and of the columns."""
    margin = 0.07
    inside = (
        room.x0 + margin < disc.x - extent[0]
        and disc.x + extent[0] < room.x1 - margin
        and room.y0 + margin < disc.y - extent[1]
        and disc.y + extent[1] < room.y1 - margin
    )
    clear_of_columns = all(
        abs(x - disc.x) > extent[0] + 0.2 or abs(y - disc.y) > extent[1] + 0.2
        for x in plan.columns_x
        for y in plan.columns_y
    )
    clear_of_skewed = all(
        wall.start[0] == wall.end[0]
        or wall.start[1] == wall.end[1]
        or _distance(disc, wall.start, wall.end) > disc.radius + margin
        for wall in plan.partitions
    )
    return inside and clear_of_columns and clear_of_skewed


def _distance(disc: _Disc, start: tuple[float, float], end: tuple[float, float]) -> float:
    a, b, p = np.asarray(start), np.asarray(end), np.array([disc.x, disc.y])
    share = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return float(np.linalg.norm(p - a - share * (b - a)))


def _touch(one: _Disc, other: _Disc) -> bool:
    return bool(np.hypot(one.x - other.x, one.y - other.y) < one.radius + other.radius)


def _pallet(rng: np.random.Generator) -> Mesh:
    """A pallet with layers of boxes or bags, not quite above one another."""
    length, width = 1.2, 0.8
    deck = [standing_box(length, width, 0.12, 0.144)]
    deck += [
        box((-length / 2, y - 0.05, 0.0), (length / 2, y + 0.05, 0.12)) for y in (-0.34, 0.0, 0.34)
    ]
    z = 0.144
    layer_height = rng.uniform(0.1, 0.3)
    for _ in range(int(rng.integers(0, 5))):
        columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        for i in range(columns):
            for j in range(rows):
                if rng.random() < 0.12:
                    continue
                x0 = -length / 2 + length * i / columns + rng.normal(0.0, 0.015)
                y0 = -width / 2 + width * j / rows + rng.normal(0.0, 0.015)
                x1, y1 = x0 + length / columns - 0.02, y0 + width / rows - 0.02
                deck.append(box((x0, y0, z), (x1, y1, z + layer_height)))
        z += layer_height
    return merge(deck)


def _board_stack(rng: np.random.Generator) -> Mesh:
    length, width = float(rng.choice([2.0, 2.5, 3.0])), 1.2
    pieces = [
        box((x - 0.05, -width / 2, 0.0), (x + 0.05, width / 2, 0.08))
        for x in np.linspace(-length / 2 + 0.2, length / 2 - 0.2, 3)
    ]
    z = 0.08
    for _ in range(int(rng.integers(1, 6))):
        thickness = rng.uniform(0.05, 0.15)
        shift = rng.normal(0.0, 0.03, 2)
        layer = standing_box(length, width, z, z + thickness)
        pieces.append(moved(layer, from_yaw(rng.normal(0.0, 0.01), (*shift, 0.0))))
        z += thickness
    return merge(pieces)


def _profile_bundle(rng: np.random.Generator) -> Mesh:
    length = rng.uniform(2.4, 3.2)
    pieces = []
    for index in range(int(rng.integers(6, 16))):
        y, z = (index % 4) * 0.09 - 0.18, (index // 4) * 0.06
        shift = rng.normal(0.0, 0.06)
        pieces.append(box((-length / 2 + shift, y, z), (length / 2 + shift, y + 0.075, z + 0.05)))
    return merge(pieces)


def _rubble(rng: np.random.Generator) -> Mesh:
    radius = rng.uniform(0.35, 0.8)
    heap = mound(radius, rng.uniform(0.25, 0.6), rng)
    pieces = []
    for _ in range(12):
        size = rng.uniform(0.06, 0.3, 3)
        distance, angle = rng.uniform(0.0, radius), rng.uniform(-np.pi, np.pi)
        place = (distance * np.cos(angle), distance * np.sin(angle), 0.0)
        lump = standing_box(size[0], size[1], 0.0, size[2] + 0.3 * (1 - distance / radius))
        pieces.append(moved(lump, from_yaw(rng.uniform(-np.pi, np.pi), place)))
    return merge([heap, *pieces])


def _bin(rng: np.random.Generator) -> Mesh:
    length, width, height = rng.uniform(0.7, 1.4), rng.uniform(0.6, 0.8), rng.uniform(0.7, 1.2)
    wall_thickness = 0.03
    x, y = length / 2, width / 2
    return merge(
        [
            standing_box(length, width, 0.08, 0.11),
            box((-x, -y, 0.08), (x, -y + wall_thickness, height)),
            box((-x, y - wall_thickness, 0.08), (x, y, height)),
            box((-x, -y, 0.08), (-x + wall_thickness, y, height)),
            box((x - wall_thickness, -y, 0.08), (x, y, height)),
            moved(mound(min(x, y) * 0.95, rng.uniform(0.2, 0.5), rng), from_yaw(0.0, (0, 0, 0.3))),
            *(
                cylinder(
                    (sx * (x - 0.1), sy * (y - 0.1), 0.0),
                    (sx * (x - 0.1), sy * (y - 0.1), 0.1),
                    0.04,
                )
                for sx in (-1, 1)
                for sy in (-1, 1)
            ),
        ]
    )


def _cable_drum(rng: np.random.Generator) -> Mesh:
    radius, width = rng.uniform(0.25, 0.5), rng.uniform(0.3, 0.5)
    half = width / 2
    return merge(
        [
            cylinder((0, -half, radius), (0, half, radius), radius * 0.6, sides=18),
            cylinder((0, -half, radius), (0, -half + 0.03, radius), radius, sides=20),
            cylinder((0, half - 0.03, radius), (0, half, radius), radius, sides=20),
        ]
    )


def _scaffold(rng: np.random.Generator) -> Mesh:
    """A mobile tower of tubes with one or two decks."""
    length, width, height = 1.8, 0.75, float(rng.choice([1.6, 2.1, 2.5]))
    x, y = length / 2, width / 2
    pieces = [
        cylinder((sx * x, sy * y, 0.0), (sx * x, sy * y, height), 0.025, sides=8)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    for sx in (-1, 1):
        pieces += [
            cylinder((sx * x, -y, z), (sx * x, y, z), 0.02, sides=8)
            for z in np.arange(0.3, height, 0.45)
        ]
    for sy in (-1, 1):
        pieces.append(cylinder((-x, sy * y, 0.3), (x, sy * y, height - 0.3), 0.02, sides=8))
        pieces.append(cylinder((-x, sy * y, height), (x, sy * y, height), 0.02, sides=8))
    deck = height - rng.uniform(0.6, 1.0)
    pieces.append(standing_box(length, width - 0.1, deck, deck + 0.04))
    return merge(pieces)


def _ladder(rng: np.random.Generator) -> Mesh:
    """A step ladder standing open."""
    height, spread = rng.uniform(1.4, 2.2), rng.uniform(0.4, 0.6)
    pieces = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            pieces.append(
                cylinder((sx * spread, sy * 0.25, 0.0), (0.0, sy * 0.18, height), 0.03, sides=6)
            )
    for z in np.arange(0.28, height, 0.28):
        x = spread * (1 - z / height)
        pieces.append(box((x - 0.05, -0.23, z - 0.015), (x + 0.05, 0.23, z + 0.015)))
    pieces.append(standing_box(0.25, 0.4, height, height + 0.03))
    return merge(pieces)


def _sawhorse_table(rng: np.random.Generator) -> Mesh:
    length, height = rng.uniform(1.4, 2.2), rng.uniform(0.75, 0.9)
    pieces = [standing_box(length, 0.7, height, height + 0.03)]
    for sx in (-1, 1):
        x = sx * (length / 2 - 0.3)
        for foot_x in (-0.2, 0.2):
            for foot_y in (-0.3, 0.3):
                foot = (x + foot_x, foot_y, 0.0)
                pieces.append(cylinder(foot, (x, foot_y, height), 0.025, sides=6))
    for _ in range(int(rng.integers(1, 5))):
        size = rng.uniform(0.1, 0.35, 3)
        tool = standing_box(size[0], size[1], height + 0.03, height + 0.03 + size[2])
        place = (rng.uniform(-0.35, 0.35) * length, rng.uniform(-0.15, 0.15), 0.0)
        pieces.append(moved(tool, from_yaw(rng.uniform(-np.pi, np.pi), place)))
    return merge(pieces)


def _buckets(rng: np.random.Generator) -> Mesh:
    pieces = []
    for index in range(int(rng.integers(2, 6))):
        radius = rng.uniform(0.1, 0.18)
        x, y = (index % 3 - 1) * 0.38, (index // 3) * 0.38 - 0.2
        pieces.append(cylinder((x, y, 0.0), (x, y, rng.uniform(0.2, 0.5)), radius, sides=14))
    return merge(pieces)


def _insulation(rng: np.random.Generator) -> Mesh:
    pieces = []
    for index in range(int(rng.integers(2, 7))):
        x = (index % 3 - 1) * 0.42
        z = 0.2 + 0.38 * (index // 3)
        pieces.append(cylinder((x, -0.55, z), (x, 0.55, z), 0.2, sides=14))
    return merge(pieces)


def _toolbox(rng: np.random.Generator) -> Mesh:
    length, height = rng.uniform(0.9, 1.4), rng.uniform(0.6, 1.0)
    body = standing_box(length, 0.6, 0.1, height)
    lid = standing_box(length * rng.uniform(0.8, 1.0), 0.64, height, height + 0.05)
    feet = [standing_box(0.1, 0.6, 0.0, 0.1)]
    return merge([body, lid, *feet])


def _leaning_boards(rng: np.random.Generator) -> Mesh:
    """Boards or door leaves stood on edge, leaning back against a wall."""
    height = float(rng.choice([1.2, 2.05, 2.4]))
    count = int(rng.integers(1, 6))
    lean = 0.25
    pieces = []
    for index in range(count):
        length = rng.uniform(0.8, 1.2)
        shift = rng.normal(0.0, 0.08)
        front = 0.3 - 0.05 * index
        corners = box((-length / 2 + shift, 0.0, 0.0), (length / 2 + shift, 0.04, height)).vertices
        corners[:, 1] += front - lean * corners[:, 2] / height - 0.2
        pieces.append(Mesh(corners, box((0, 0, 0), (1, 1, 1)).triangles))
    return merge(pieces)


def _desk(rng: np.random.Generator) -> Mesh:
    length = float(rng.choice([1.4, 1.6, 1.8]))
    pieces = [standing_box(length, 0.8, 0.71, 0.74)]
    pieces += [
        box((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, 0.71))
        for x in (-length / 2 + 0.06, length / 2 - 0.06)
        for y in (-0.34, 0.34)
    ]
    if rng.random() < 0.5:
        screen_x = rng.uniform(-0.3, 0.3)
        pieces.append(box((screen_x - 0.28, -0.2, 0.85), (screen_x + 0.28, -0.17, 1.2)))
        pieces.append(box((screen_x - 0.03, -0.2, 0.74), (screen_x + 0.03, -0.16, 0.9)))
    if rng.random() < 0.6:
        pieces.append(moved(_chair(rng), from_yaw(rng.uniform(2.2, 4.0), (0.1, 0.65, 0.0))))
    return merge(pieces)


def _chair(rng: np.random.Generator) -> Mesh:
    seat = rng.uniform(0.42, 0.5)
    legs = [
        cylinder((0.0, 0.0, 0.06), (0.28 * np.cos(a), 0.28 * np.sin(a), 0.03), 0.03, sides=6)
        for a in np.arange(5) * (2 * np.pi / 5)
    ]
    return merge(
        [
            *legs,
            cylinder((0, 0, 0.05), (0, 0, seat), 0.03, sides=8),
            standing_box(0.46, 0.46, seat, seat + 0.07),
            box((-0.21, -0.25, seat + 0.15), (0.21, -0.2, seat + 0.6)),
        ]
    )


def _cabinet(rng: np.random.Generator) -> Mesh:
    length, height = float(rng.choice([0.8, 1.0, 1.2])), float(rng.choice([0.75, 1.15, 1.95]))
    pieces = [standing_box(length, 0.42, 0.0, height)]
    if height < 1.5 and rng.random() < 0.7:
        pieces.append(
            standing_box(rng.uniform(0.25, 0.6), 0.3, height, height + rng.uniform(0.1, 0.4))
        )
    return merge(pieces)


def _shelf(rng: np.random.Generator) -> Mesh:
    length, height = rng.uniform(0.9, 1.6), rng.uniform(1.5, 2.1)
    pieces = [standing_box(length, 0.4, z, z + 0.03) for z in np.arange(0.1, height, 0.42)]
    pieces += [
        box((x - 0.02, -0.2, 0.0), (x + 0.02, 0.2, height)) for x in (-length / 2, length / 2)
    ]
    for z in np.arange(0.13, height - 0.4, 0.42):
        size = rng.uniform(0.15, 0.35, 2)
        x = rng.uniform(-0.3, 0.3) * length
        pieces.append(box((x - size[0] / 2, -0.15, z), (x + size[0] / 2, 0.15, z + size[1])))
    return merge(pieces)


def _cartons(rng: np.random.Generator) -> Mesh:
    pieces = []
    for index in range(int(rng.integers(2, 6))):
        size = rng.uniform(0.25, 0.55, 3)
        place = ((index % 2 - 0.5) * 0.6, (index // 2 - 1) * 0.5, 0.0)
        carton = standing_box(size[0], size[1], 0.0, size[2])
        pieces.append(moved(carton, from_yaw(rng.normal(0.0, 0.3), place)))
    return merge(pieces)


_THINGS = (
    _Thing(_pallet, "pallet", False, (3, 2, 0.5)),
    _Thing(_board_stack, "board_stack", True, (2, 2, 0.3)),
    _Thing(_profile_bundle, "profile_bundle", True, (2, 2, 0)),
    _Thing(_rubble, "rubble", False, (2, 1, 0.3)),
    _Thing(_bin, "bin", False, (1, 1, 0.7)),
    _Thing(_cable_drum, "cable_drum", False, (1, 2, 0.5)),
    _Thing(_scaffold, "scaffold", False, (1.5, 2, 0.3)),
    _Thing(_ladder, "ladder", False, (1, 2, 1)),
    _Thing(_sawhorse_table, "sawhorse_table", False, (1, 1.5, 0.5)),
    _Thing(_buckets, "buckets", True, (1, 1.5, 1)),
    _Thing(_insulation, "insulation", True, (0.5, 2, 0)),
    _Thing(_toolbox, "toolbox", True, (1, 1, 0.5)),
    _Thing(_leaning_boards, "leaning_boards", True, (1, 2, 1)),
    _Thing(_desk, "desk", False, (0, 0, 3)),
    _Thing(_chair, "chair", False, (0, 0, 1)),
    _Thing(_cabinet, "cabinet", True, (0, 0, 3)),
    _Thing(_shelf, "shelf", True, (0, 0.3, 2)),
    _Thing(_cartons, "cartons", False, (0.3, 1, 2)),
)
