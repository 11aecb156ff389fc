"""A construction floor drawn at random: elements with the stages at which they are there."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from nss_ros.config import SiteConfig
from nss_ros.config.site import Part
from nss_ros.simulation.element import Element
from nss_ros.simulation.procedural.ceilings import (
    build_ceilings,
    build_raised_floors,
    draw_raised_floors,
)
from nss_ros.simulation.procedural.clutter import build_contents
from nss_ros.simulation.procedural.facade import build_facade
from nss_ros.simulation.procedural.layout import draw_layout
from nss_ros.simulation.procedural.partitions import build_partitions
from nss_ros.simulation.procedural.plan import Plan, draw_plan
from nss_ros.simulation.procedural.programme import Programme, draw_programme, stage_names
from nss_ros.simulation.procedural.services import build_services
from nss_ros.simulation.procedural.structure import build_structure
from nss_ros.simulation.site import Rectangle, Site


def build_floor(area: str, config: SiteConfig, seed: int) -> Site:
    """A random floor: shell, then partitions, services, finishes, clutter and furniture.

    Every part draws from a stream of its own, so that a change in one leaves the others alone.

    Args:
        area: its name; floors of other names differ.
        config: size, shape, use, stages and difficulty.
        seed: same seed, area and settings give the same floor.

    Returns:
        The site, its bare floor at z = 0, with no floor outside the building.

    Raises:
        InputError: the wings run into one another.
    """
    key = zlib.crc32(area.encode())
    streams = [np.random.default_rng((seed, key, part)) for part in range(8)]
    plan = draw_plan(config, streams[0])
    programme = draw_programme(config, plan.zone_order(), streams[1])
    structure = build_structure(plan, programme, config.renovation, config.deviation, streams[2])
    facade = build_facade(plan, programme, config.renovation, streams[3])
    elements = [element for element in structure if element.kind not in config.without]
    elements += _unless("facade", facade, config)
    elements = [replace(element, mesh=plan.grid.built(element.mesh)) for element in elements]
    if config.renovation:
        elements += _fitted_out(plan, replace(programme, former=True), config, streams[4:6])
    elements += _fitted_out(plan, programme, config, streams[6:8])
    return Site(
        area,
        config.stages,
        tuple(elements),
        _extent(elements),
        stage_names=stage_names(config),
        source={"procedural": config.model_dump(mode="json"), "seed": seed},
    )


def _fitted_out(
    plan: Plan, programme: Programme, config: SiteConfig, streams: list[np.random.Generator]
) -> list[Element]:
    """All that a layout brings, map frame."""
    layout = draw_layout(plan, config, streams[0])
    rngs = streams[1].spawn(6)
    raised = draw_raised_floors(layout.rooms, programme, rngs[3])
    built = [
        *build_partitions(layout.walls, plan.height, programme, config.deviation, rngs[0]),
        *_unless("services", build_services(plan, layout.rooms, programme, rngs[1]), config),
        *_unless("ceilings", build_ceilings(plan, layout.rooms, programme, rngs[2]), config),
        *build_raised_floors(layout.rooms, raised, rngs[4]),
    ]
    elements = [replace(element, mesh=plan.grid.built(element.mesh)) for element in built]
    contents = build_contents(plan, layout, raised, programme, config, rngs[5])
    return elements + _unless("contents", contents, config)


def _unless(part: Part, elements: list[Element], config: SiteConfig) -> list[Element]:
    """The elements, or none where the floor is drawn without them."""
    return [] if part in config.without else elements


def _extent(elements: list[Element]) -> Rectangle:
    slabs = [element.mesh.vertices for element in elements if element.kind == "floor_slab"]
    corners = np.concatenate(slabs)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return Rectangle(float(low[0]), float(low[1]), float(high[0]), float(high[1]))
