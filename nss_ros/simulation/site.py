"""A site over time: what stands where at which stage, from whatever source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.simulation.element import Element
from nss_ros.simulation.mesh import Mesh, merge


@dataclass(frozen=True, slots=True)
class Rectangle:
    """An axis-aligned area of the floor, metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def area(self) -> float:
        """Square metres."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)


@dataclass(frozen=True, slots=True)
class StageMesh:
    """All that is there at one stage.

    Attributes:
        mesh: map frame.
        elements: (m,) int32, per triangle the index of its element in the site.
        materials: (m,) uint8, per triangle the `Material` of its element.
    """

    mesh: Mesh
    elements: NDArray[np.int32]
    materials: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Site:
    """One area (a building floor) over all its stages; map frame, z up, metres.

    Attributes:
        area: name of the area in fragment ids.
        stages: number of stages; they are numbered from 1.
        elements: everything that is there at some stage; an element's index is its id.
        extent: in which tripods may be put; the building's outline lies inside.
        floor_height: z of the bare floor on which tripods stand.
        stage_names: what each stage is, for people; empty or one per stage.
        source: how the site was made (file names and hashes, or seed and settings), as JSON
            can hold it.
    """

    area: str
    stages: int
    elements: tuple[Element, ...]
    extent: Rectangle
    floor_height: float = 0.0
    stage_names: tuple[str, ...] = ()
    source: Mapping[str, Any] = field(default_factory=dict)

    def stage_mesh(self, stage: int) -> StageMesh:
        """The mesh of one stage, from 1.

        Raises:
            InputError: there is no such stage.
        """
        if not 1 <= stage <= self.stages:
            raise InputError(f"Stage {stage} does not exist: this site has 1 to {self.stages}.")
        present = [(i, e) for i, e in enumerate(self.elements) if stage in e.stages]
        counts = [len(element.mesh.triangles) for _, element in present]
        ids = np.repeat(np.array([index for index, _ in present], dtype=np.int32), counts)
        materials = np.array([e.material for e in self.elements], dtype=np.uint8)
        return StageMesh(merge([e.mesh for _, e in present]), ids, materials[ids])


def changed_since(site: Site, elements: NDArray[np.int32], stage: int) -> NDArray[np.bool_]:
    """Which points lie on something that is not there at another stage.

    Args:
        site: whose elements they are.
        elements: (n,) index of the element under each point.
        stage: the other stage.

    Returns:
        (n,) True where the element is absent at that stage.
    """
    there = np.array([stage in element.stages for element in site.elements], dtype=bool)
    return np.asarray(~there[elements])
