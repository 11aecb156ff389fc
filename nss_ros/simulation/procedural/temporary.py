"""What comes and goes with the works: loose material, lamps, hoses, cables, dust sheets.

It is small or hangs, so that one can walk all the same, and most of it is elsewhere at the next
stage: a floor that is bare but for its stacks and tools is one on which scans of the same stage
are too hard to register, and scans of different stages too easy.

Each is made around the z axis, between the floor at z = 0 and a ceiling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nss_ros.geometry import exponential, from_yaw
from nss_ros.simulation.mesh import (
    Mesh,
    cylinder,
    cylinders,
    merge,
    mound,
    moved,
    standing_box,
)

_HEAD = 2.0
"""What hangs ends above, metres."""


@dataclass(frozen=True, slots=True)
class Temporary:
    """A kind of thing.

    Attributes:
        make: draws one, for a ceiling at some height, metres.
        kind: of its element.
        density: how many are drawn per square metre, at most; those that do not fit are not there.
        shares: of that in each of `things.PHASES`.
        hangs: above the heads, where nothing is in its way.
        wide: it leaves no way in a corridor.
    """

    make: Callable[[np.random.Generator, float], Mesh]
    kind: str
    density: float
    shares: tuple[float, ...]
    hangs: bool = False
    wide: bool = False


def offcuts(rng: np.random.Generator, _top: float) -> Mesh:
    """Pieces of boards and blocks, thrown on a heap."""
    pieces = []
    for _ in range(int(rng.integers(3, 7))):
        length, width = rng.uniform(0.1, 0.45, 2)
        piece = _thrown(standing_box(length, width, 0.0, rng.uniform(0.05, 0.35)), 0.3, rng)
        place = (*rng.normal(0.0, 0.2, 2), 0.0)
        pieces.append(moved(piece, from_yaw(rng.uniform(-np.pi, np.pi), place)))
    return merge(pieces)


def sack(rng: np.random.Generator, _top: float) -> Mesh:
    """A sack of rubbish, or some sand."""
    return mound(rng.uniform(0.2, 0.45), rng.uniform(0.2, 0.45), rng)


def crate(rng: np.random.Generator, _top: float) -> Mesh:
    """A box of tools or fittings, a machine."""
    length, width, height = rng.uniform((0.25, 0.15, 0.12), (0.65, 0.5, 0.48))
    return _thrown(standing_box(length, width, 0.0, height), 0.06, rng)


def tub(rng: np.random.Generator, _top: float) -> Mesh:
    """A bucket or a tub of plaster."""
    return cylinder((0, 0, 0), (0, 0, rng.uniform(0.2, 0.48)), rng.uniform(0.1, 0.25))


def roll(rng: np.random.Generator, _top: float) -> Mesh:
    """A short roll of foil or felt, or a gas bottle, lying."""
    radius, half = rng.uniform(0.08, 0.2), rng.uniform(0.2, 0.45)
    return cylinder((-half, 0, radius), (half, 0, radius), radius)


def lamp(rng: np.random.Generator, top: float) -> Mesh:
    """A lamp on its cable."""
    length, width = rng.uniform(0.15, 0.5, 2)
    z = max(top - rng.uniform(0.2, 1.0), _HEAD)
    shade = standing_box(length, width, z, z + 0.15)
    return merge([shade, cylinder((0, 0, z + 0.1), (0, 0, top), 0.01, sides=5)])


def hose(rng: np.random.Generator, top: float) -> Mesh:
    """A flexible duct that sags between two hooks."""
    half, radius = rng.uniform(0.5, 1.4), rng.uniform(0.06, 0.16)
    along = np.linspace(-1.0, 1.0, 8)
    sag = rng.uniform(0.2, 1.0)
    z = top - 0.1 - radius - sag * (1 - along**2) + rng.normal(0.0, 0.03, 8)
    z = np.maximum(z, _HEAD + radius)
    path = np.column_stack((half * along, rng.normal(0.0, 0.08, 8), z))
    return cylinders(path[:-1], path[1:], radius, sides=8)


def cables(rng: np.random.Generator, top: float) -> Mesh:
    """Ends of cables and hoses that hang out of the ceiling."""
    count = int(rng.integers(2, 6))
    ends = rng.normal(0.0, 0.15, (count, 2))
    low = np.maximum(top - rng.uniform(0.3, 1.2, count), _HEAD)
    start = np.column_stack((ends, low))
    return cylinders(start, np.column_stack((ends / 2, np.full(count, top))), 0.03, sides=5)


def floor_lamp(rng: np.random.Generator, _top: float) -> Mesh:
    """A lamp, or an instrument, on three legs."""
    height = rng.uniform(1.2, 2.0)
    angles = np.arange(3) * (2 * np.pi / 3)
    feet = np.column_stack((0.4 * np.cos(angles), 0.4 * np.sin(angles), np.zeros(3)))
    legs = cylinders(feet, (0.0, 0.0, 0.6 * height), 0.02, sides=5)
    mast = cylinder((0, 0, 0.4 * height), (0, 0, height), 0.02, sides=6)
    return merge([legs, mast, standing_box(0.35, 0.15, height - 0.25, height)])


def dust_sheet(rng: np.random.Generator, top: float) -> Mesh:
    """Foil hung up against dust, in folds, not always down to the floor."""
    length = rng.uniform(0.8, 2.2)
    count = int(length / 0.12)
    x = np.linspace(-length / 2, length / 2, count)
    fold = np.cumsum(rng.normal(0.0, 0.06, count))
    fold -= np.linspace(fold[0], fold[-1], count)
    low = rng.uniform(0.05, 1.2) + rng.normal(0.0, 0.04, count)
    upper = np.column_stack((x, 0.4 * fold, np.full(count, top)))
    lower = np.column_stack((x, fold, np.maximum(low, 0.0)))
    here = np.arange(count - 1, dtype=np.int32)
    one = np.column_stack((here, here + 1, here + count))
    other = np.column_stack((here + 1, here + count + 1, here + count))
    return Mesh(np.concatenate((upper, lower)), np.concatenate((one, other)).astype(np.int32))


def _thrown(mesh: Mesh, tilt: float, rng: np.random.Generator) -> Mesh:
    """A thing that does not stand straight, but on an edge: turned about all axes, radians."""
    turned = moved(mesh, exponential((0.0, 0.0, 0.0, *rng.normal(0.0, tilt, 3))))
    return moved(turned, from_yaw(0.0, (0.0, 0.0, -turned.vertices[:, 2].min())))


# Shares in use, at strip-out, shell, framing, closing, finishing.
_LYING = (0.05, 1.0, 0.7, 1.0, 1.0, 0.5)
_PUT_UP = (0.0, 1.0, 0.6, 1.0, 1.0, 0.4)

# Those that need most room come first.
TEMPORARIES = (
    Temporary(dust_sheet, "dust_sheet", 0.06, _PUT_UP, wide=True),
    Temporary(floor_lamp, "floor_lamp", 0.05, _PUT_UP, wide=True),
    Temporary(offcuts, "offcuts", 0.25, _LYING),
    Temporary(sack, "sack", 0.2, _LYING),
    Temporary(crate, "crate", 0.2, _LYING),
    Temporary(tub, "tub", 0.15, _LYING),
    Temporary(roll, "roll", 0.15, _LYING),
    Temporary(lamp, "lamp", 0.1, _PUT_UP, hangs=True),
    Temporary(hose, "hose", 0.15, _PUT_UP, hangs=True),
    Temporary(cables, "cables", 0.1, _PUT_UP, hangs=True),
)
