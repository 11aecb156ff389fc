"""A construction floor drawn at random: elements with the stages at which they are there."""

from __future__ import annotations

import numpy as np

from nss_ros.config import SiteConfig
from nss_ros.simulation.procedural.clutter import build_clutter
from nss_ros.simulation.procedural.partitions import build_partitions
from nss_ros.simulation.procedural.plan import draw_plan
from nss_ros.simulation.procedural.services import build_services
from nss_ros.simulation.procedural.structure import build_structure
from nss_ros.simulation.site import Rectangle, Site


def build_floor(area: str, config: SiteConfig, seed: int) -> Site:
    """A random floor: shell, then partitions, services, clutter and furniture, stage by stage.

    Every part draws from a stream of its own, so that a change in one leaves the others alone.
    """
    streams = [np.random.default_rng((seed, part)) for part in range(5)]
    plan = draw_plan(config, streams[0])
    elements = (
        *build_structure(plan, config.stages, streams[1]),
        *build_partitions(plan, streams[2]),
        *build_services(plan, config.stages, streams[3]),
        *build_clutter(plan, config.stages, streams[4]),
    )
    return Site(
        area,
        config.stages,
        elements,
        Rectangle(0.0, 0.0, plan.width, plan.depth),
        source={"procedural": config.model_dump(), "seed": seed},
    )
