"""One building element or thing on a site, and the stages at which it is there."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from nss_ros.simulation.mesh import Mesh


class Material(IntEnum):
    """What a surface does to the infrared light of a depth sensor."""

    MATT = 0
    """Returns at all but grazing angles: concrete, board, wood."""
    DARK = 1
    """Absorbs: bitumen, rubber, black foil; returns from short distances only."""
    METAL = 2
    """Shines: studs, ducts, foil on insulation; returns get lost at smaller angles."""
    GLASS = 3
    """Gives next to no return."""


@dataclass(frozen=True, slots=True)
class Element:
    """Something that is put in place, stays, and may be taken away as a whole.

    A thing that moves, or changes its shape, is one element per place and shape.

    Attributes:
        kind: what it is, for example `column` or `pallet`.
        stages: stages (from 1) at which it is there.
        mesh: where it is, map frame.
        material: of its surface.
        name: which one it is, for people; may be empty.
    """

    kind: str
    stages: frozenset[int]
    mesh: Mesh
    material: Material = Material.MATT
    name: str = ""


def stages_from(first: int, last: int) -> frozenset[int]:
    """The stages from `first` to `last`, both included."""
    return frozenset(range(first, last + 1))
