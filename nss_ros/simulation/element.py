"""One building element or thing on a site, and the stages at which it is there."""

from __future__ import annotations

from dataclasses import dataclass

from nss_ros.simulation.mesh import Mesh


@dataclass(frozen=True, slots=True)
class Element:
    """Something that is put in place, stays, and may be taken away as a whole.

    Attributes:
        kind: what it is, for example `column` or `pallet`.
        stages: stages (from 1) at which it is there.
        mesh: where it is, map frame.
    """

    kind: str
    stages: frozenset[int]
    mesh: Mesh


def stages_from(first: int, last: int) -> frozenset[int]:
    """The stages from `first` to `last`, both included."""
    return frozenset(range(first, last + 1))
