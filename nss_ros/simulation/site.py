"""A procedural construction floor: elements with the stages at which they are there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import SiteConfig
from nss_ros.errors import InputError
from nss_ros.simulation.clutter import build_clutter
from nss_ros.simulation.element import Element
from nss_ros.simulation.mesh import Mesh, merge
from nss_ros.simulation.partitions import build_partitions
from nss_ros.simulation.plan import Plan, draw_plan
from nss_ros.simulation.services import build_services
from nss_ros.simulation.structure import build_structure


@dataclass(frozen=True, slots=True)
class StageMesh:
    """All that is there at one stage.

    Attributes:
        mesh: map frame.
        elements: (m,) int32, per triangle the index of its element in the site.
    """

    mesh: Mesh
    elements: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Site:
    """A floor over time; map frame, z = 0 on the floor slab.

    Attributes:
        plan: what it was built from.
        stages: number of stages.
        elements: everything that is there at some stage; an element's index is its id.
    """

    plan: Plan
    stages: int
    elements: tuple[Element, ...]

    def stage_mesh(self, stage: int) -> StageMesh:
        """The mesh of one stage, from 1.

        Raises:
            InputError: there is no such stage.
        """
        if not 1 <= stage <= self.stages:
            raise InputError(f"Stage {stage} does not exist: this site has 1 to {self.stages}.")
        present = [(i, e.mesh) for i, e in enumerate(self.elements) if stage in e.stages]
        counts = [len(mesh.triangles) for _, mesh in present]
        ids = np.repeat(np.array([index for index, _ in present], dtype=np.int32), counts)
        return StageMesh(merge([mesh for _, mesh in present]), ids)


def build_site(config: SiteConfig, seed: int) -> Site:
    """A random floor: shell, then partitions, services, clutter and furniture, stage by stage.

    Every part draws from a stream of its own, so that a change in one leaves the others alone.
    """
    streams = [np.random.default_rng((seed, part)) for part in range(5)]
    plan = draw_plan(config, streams[0])
    elements = [
        *build_structure(plan, config.stages, streams[1]),
        *build_partitions(plan, streams[2]),
        *build_services(plan, config.stages, streams[3]),
        *build_clutter(plan, config.stages, streams[4]),
    ]
    return Site(plan, config.stages, tuple(elements))
