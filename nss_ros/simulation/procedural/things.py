"""Things of a building site: stacks of material, tools, lifts, rubbish.

Each is made around the z axis, standing on the floor, its longer side along x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Material
from nss_ros.simulation.mesh import (
    Mesh,
    box,
    boxes,
    cylinder,
    cylinders,
    merge,
    mound,
    moved,
    standing_box,
)

PHASES = ("in use", "strip-out", "shell", "framing", "closing", "finishing")

DENSITIES = (0.01, 0.08, 0.05, 0.09, 0.09, 0.04)
"""Things per square metre in each of `PHASES`."""
STAYS = 0.15
"""Share of them that are still there at the next stage."""


@dataclass(frozen=True, slots=True)
class Thing:
    """A kind of thing.

    Attributes:
        make: draws one.
        kind: of its element.
        against_wall: where it is put.
        weights: how often it is met in each of `PHASES`.
        material: of its surface.
    """

    make: Callable[[np.random.Generator], Mesh]
    kind: str
    against_wall: bool
    weights: tuple[float, ...]
    material: Material = Material.MATT


def pallet(rng: np.random.Generator) -> Mesh:
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


def board_stack(rng: np.random.Generator) -> Mesh:
    """Plasterboard or formwork on bearers."""
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


def profile_bundle(rng: np.random.Generator) -> Mesh:
    """Studs and tracks, bundled."""
    length = rng.uniform(2.4, 3.2)
    pieces = []
    for index in range(int(rng.integers(6, 16))):
        y, z = (index % 4) * 0.09 - 0.18, (index // 4) * 0.06
        shift = rng.normal(0.0, 0.06)
        pieces.append(box((-length / 2 + shift, y, z), (length / 2 + shift, y + 0.075, z + 0.05)))
    return merge(pieces)


def rubble(rng: np.random.Generator) -> Mesh:
    """A heap with lumps in it."""
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


def bin_(rng: np.random.Generator) -> Mesh:
    """An open skip on wheels, filled to some height."""
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


def cable_drum(rng: np.random.Generator) -> Mesh:
    """A drum standing on its flanges."""
    radius, width = rng.uniform(0.25, 0.5), rng.uniform(0.3, 0.5)
    half = width / 2
    return merge(
        [
            cylinder((0, -half, radius), (0, half, radius), radius * 0.6, sides=18),
            cylinder((0, -half, radius), (0, -half + 0.03, radius), radius, sides=20),
            cylinder((0, half - 0.03, radius), (0, half, radius), radius, sides=20),
        ]
    )


def scaffold(rng: np.random.Generator) -> Mesh:
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


def ladder(rng: np.random.Generator) -> Mesh:
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


def sawhorse_table(rng: np.random.Generator) -> Mesh:
    """Boards on two trestles, tools on them."""
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


def buckets(rng: np.random.Generator) -> Mesh:
    """Buckets side by side."""
    pieces = []
    for index in range(int(rng.integers(2, 6))):
        radius = rng.uniform(0.1, 0.18)
        x, y = (index % 3 - 1) * 0.38, (index // 3) * 0.38 - 0.2
        pieces.append(cylinder((x, y, 0.0), (x, y, rng.uniform(0.2, 0.5)), radius, sides=14))
    return merge(pieces)


def insulation_rolls(rng: np.random.Generator) -> Mesh:
    """Rolls lying in layers."""
    pieces = []
    for index in range(int(rng.integers(2, 7))):
        x = (index % 3 - 1) * 0.42
        z = 0.2 + 0.38 * (index // 3)
        pieces.append(cylinder((x, -0.55, z), (x, 0.55, z), 0.2, sides=14))
    return merge(pieces)


def toolbox(rng: np.random.Generator) -> Mesh:
    """A site chest with its lid."""
    length, height = rng.uniform(0.9, 1.4), rng.uniform(0.6, 1.0)
    body = standing_box(length, 0.6, 0.1, height)
    lid = standing_box(length * rng.uniform(0.8, 1.0), 0.64, height, height + 0.05)
    feet = [standing_box(0.1, 0.6, 0.0, 0.1)]
    return merge([body, lid, *feet])


def leaning_boards(rng: np.random.Generator) -> Mesh:
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


def cartons(rng: np.random.Generator) -> Mesh:
    """Cartons of several sizes."""
    pieces = []
    for index in range(int(rng.integers(2, 6))):
        size = rng.uniform(0.25, 0.55, 3)
        place = ((index % 2 - 0.5) * 0.6, (index // 2 - 1) * 0.5, 0.0)
        carton = standing_box(size[0], size[1], 0.0, size[2])
        pieces.append(moved(carton, from_yaw(rng.normal(0.0, 0.3), place)))
    return merge(pieces)


def scissor_lift(rng: np.random.Generator) -> Mesh:
    """A lift with its platform somewhere between parked and at the ceiling."""
    platform = rng.uniform(0.9, 1.6)
    wheels = [(x, y, 0.12) for x in (-0.6, 0.6) for y in (-0.36, 0.3)]
    frames = boxes(
        [
            (-0.85, -0.38, 0.1),
            (-0.85, -0.38, platform),
            *((x, -0.38, platform) for x in (-0.85, 0.8)),
        ],
        [
            (0.85, 0.38, 0.42),
            (0.85, 0.38, platform + 0.08),
            *((x + 0.05, 0.38, platform + 1.0) for x in (-0.85, 0.8)),
        ],
    )
    arms = cylinders(
        [(-0.7, -0.3, 0.42), (0.7, -0.3, 0.42), (-0.7, 0.3, 0.42), (0.7, 0.3, 0.42)],
        [
            (0.7, -0.3, platform),
            (-0.7, -0.3, platform),
            (0.7, 0.3, platform),
            (-0.7, 0.3, platform),
        ],
        0.04,
        sides=6,
    )
    rails = cylinders(
        [(-0.85, y, platform + z) for y in (-0.38, 0.38) for z in (0.5, 1.0)],
        [(0.85, y, platform + z) for y in (-0.38, 0.38) for z in (0.5, 1.0)],
        0.02,
        sides=6,
    )
    tyres = cylinders(wheels, [(x, y + 0.08, z) for x, y, z in wheels], 0.12, sides=12)
    return merge([frames, arms, rails, tyres])


def site_toilet(rng: np.random.Generator) -> Mesh:
    """A cabin with its door shut."""
    height = rng.uniform(2.1, 2.25)
    return boxes(
        [(-0.55, -0.55, 0.0), (-0.5, -0.5, 0.1), (-0.3, -0.53, 0.2)],
        [(0.55, 0.55, 0.1), (0.5, 0.5, height), (0.3, -0.49, height - 0.2)],
    )


def pipe_stack(rng: np.random.Generator) -> Mesh:
    """Pipes of one size on bearers, heaped in a pyramid."""
    radius, length = float(rng.choice([0.03, 0.055, 0.08])), rng.uniform(2.4, 3.2)
    rows = int(rng.integers(2, 5))
    centres = [
        ((index - (rows - row) / 2) * 2 * radius, 0.1 + radius + 1.75 * row * radius)
        for row in range(rows)
        for index in range(rows - row + 1)
    ]
    shifts = rng.normal(0.0, 0.05, len(centres))
    tubes = cylinders(
        [(-length / 2 + s, y, z) for (y, z), s in zip(centres, shifts, strict=True)],
        [(length / 2 + s, y, z) for (y, z), s in zip(centres, shifts, strict=True)],
        radius,
        sides=10,
    )
    half = (rows + 1) * radius
    bearers = boxes(
        [(x - 0.05, -half, 0.0) for x in (-length / 3, length / 3)],
        [(x + 0.05, half, 0.1) for x in (-length / 3, length / 3)],
    )
    return merge([tubes, bearers])


def block_pallet(rng: np.random.Generator) -> Mesh:
    """A pallet with blocks in regular courses, partly used."""
    courses = int(rng.integers(1, 5))
    x, y, z = np.meshgrid(np.arange(3), np.arange(4), np.arange(courses), indexing="ij")
    kept = (z < courses - 1) | (rng.random(z.shape) < 0.6)
    places = np.stack((x, y, z), axis=-1)[kept] * (0.4, 0.2, 0.25) + (-0.6, -0.4, 0.14)
    gaps = rng.normal(0.0, 0.004, places.shape) * (1, 1, 0)
    blocks = boxes(places + gaps, places + gaps + (0.39, 0.19, 0.25))
    deck = boxes(
        [(-0.6, -0.4, 0.1), *((-0.6, v - 0.05, 0.0) for v in (-0.34, 0.0, 0.34))],
        [(0.6, 0.4, 0.14), *((0.6, v + 0.05, 0.1) for v in (-0.34, 0.0, 0.34))],
    )
    return merge([blocks, deck])


def membrane_rolls(rng: np.random.Generator) -> Mesh:
    """Rolls of bitumen sheet standing on end."""
    count = int(rng.integers(2, 7))
    places = [((k % 3 - 1) * 0.33, (k // 3 - 0.5) * 0.33, 0.0) for k in range(count)]
    tops = [(x, y, 1.0) for x, y, _ in places]
    return cylinders(places, tops, rng.uniform(0.13, 0.16), sides=14)


def duct_pieces(rng: np.random.Generator) -> Mesh:
    """Lengths of duct waiting to be hung."""
    count = int(rng.integers(2, 6))
    pieces = []
    for index in range(count):
        length, width = rng.uniform(1.0, 1.5), rng.uniform(0.25, 0.55)
        piece = standing_box(length, width, 0.0, 0.3)
        place = (rng.normal(0.0, 0.08), (index % 2 - 0.5) * 0.65, 0.31 * (index // 2))
        pieces.append(moved(piece, from_yaw(rng.normal(0.0, 0.05), place)))
    return merge(pieces)


def barrow(rng: np.random.Generator) -> Mesh:
    """A wheelbarrow, or a mixer's trough on its legs."""
    depth = rng.uniform(0.2, 0.3)
    tray = boxes(
        [(-0.45, -0.3, 0.35), (-0.45, -0.3, 0.35), (-0.45, 0.27, 0.35), (-0.45, -0.3, 0.35)],
        [
            (0.45, 0.3, 0.38),
            (0.45, -0.27, 0.38 + depth),
            (0.45, 0.3, 0.38 + depth),
            (-0.42, 0.3, 0.6),
        ],
    )
    legs = cylinders(
        [(-0.3, -0.2, 0.0), (-0.3, 0.2, 0.0), (-0.95, -0.25, 0.55), (-0.95, 0.25, 0.55)],
        [(-0.3, -0.2, 0.36), (-0.3, 0.2, 0.36), (0.3, -0.2, 0.34), (0.3, 0.2, 0.34)],
        0.02,
        sides=6,
    )
    wheel = cylinder((0.5, -0.05, 0.2), (0.5, 0.05, 0.2), 0.2, sides=14)
    return merge([tray, legs, wheel])


def tall_rack(rng: np.random.Generator) -> Mesh:
    """Upright rack with plates of glass or boards, as window makers bring them."""
    count = int(rng.integers(3, 9))
    lean = 0.12
    pieces = [boxes((-0.9, -0.3, 0.0), (0.9, 0.3, 0.12))]
    for index in range(count):
        plate = box((-0.75, 0.0, 0.12), (0.75 + rng.normal(0.0, 0.05), 0.03, 1.6))
        plate.vertices[:, 1] += lean * (plate.vertices[:, 2] - 0.12) - 0.25 + 0.05 * index
        pieces.append(plate)
    return merge(pieces)


# How often each is met: in use, strip-out, shell, framing, closing, finishing.
THINGS = (
    Thing(pallet, "pallet", False, (0, 0.5, 2, 2, 1.5, 0.5)),
    Thing(block_pallet, "block_pallet", False, (0, 0, 2, 2, 0.3, 0)),
    Thing(board_stack, "board_stack", True, (0, 0.3, 0.7, 3, 2.5, 0.3)),
    Thing(profile_bundle, "profile_bundle", True, (0, 0.3, 1, 2.5, 0.7, 0), Material.METAL),
    Thing(pipe_stack, "pipe_stack", True, (0, 0, 0.7, 1.5, 1, 0), Material.METAL),
    Thing(duct_pieces, "duct_pieces", False, (0, 0.5, 0.5, 1.5, 1, 0), Material.METAL),
    Thing(rubble, "rubble", False, (0, 4, 1, 1, 0.7, 0.2)),
    Thing(bin_, "bin", False, (0.2, 2, 0.7, 1, 1, 0.7)),
    Thing(cable_drum, "cable_drum", False, (0, 0, 0.5, 1.5, 1.5, 0.3)),
    Thing(scaffold, "scaffold", False, (0, 1, 1, 2, 2, 0.3), Material.METAL),
    Thing(scissor_lift, "scissor_lift", False, (0, 0.7, 0.5, 1.3, 1.2, 0.2)),
    Thing(ladder, "ladder", False, (0.1, 1, 0.5, 1.2, 1.5, 1)),
    Thing(sawhorse_table, "sawhorse_table", False, (0, 0.3, 0.5, 1.2, 1.5, 0.5)),
    Thing(buckets, "buckets", True, (0, 0.5, 0.5, 1, 1.5, 1)),
    Thing(insulation_rolls, "insulation_rolls", True, (0, 0.3, 0.2, 2, 1.5, 0)),
    Thing(membrane_rolls, "membrane_rolls", True, (0, 0, 1, 0.6, 0.2, 0), Material.DARK),
    Thing(toolbox, "toolbox", True, (0, 0.7, 1, 1, 1, 0.5)),
    Thing(leaning_boards, "leaning_boards", True, (0, 1.5, 0.3, 1.5, 2, 1)),
    Thing(barrow, "barrow", False, (0, 1, 1, 0.7, 0.4, 0)),
    Thing(tall_rack, "rack", True, (0, 0.3, 0.4, 1, 0.7, 0)),
    Thing(site_toilet, "site_toilet", True, (0, 0.1, 0.3, 0.15, 0.1, 0)),
    Thing(cartons, "cartons", False, (1, 1, 0.2, 0.7, 1, 2.5)),
)


def draw_thing(phase: int, rng: np.random.Generator) -> Thing:
    """A kind of thing as often as it is met in one of `PHASES`."""
    weights = np.array([thing.weights[phase] for thing in THINGS])
    return THINGS[int(rng.choice(len(THINGS), p=weights / weights.sum()))]
