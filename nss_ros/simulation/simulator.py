"""From settings to scans: site, viewpoints, fragments with their poses, pairs, ground truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nss_ros import __version__
from nss_ros.config import SimulationConfig
from nss_ros.dataset.overlap import Cloud, all_overlaps
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, voxelize
from nss_ros.geometry import Transform, relative
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.rig import draw_pose, scan
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Site
from nss_ros.simulation.viewpoints import choose_viewpoints, occupancy_map

_VIEWPOINT_STREAM, _SCAN_STREAM = 1, 2


@dataclass(frozen=True, slots=True)
class Scan:
    """A fragment and where it was taken."""

    fragment: Fragment
    T_map_fragment: Transform


def simulate_scans(
    config: SimulationConfig, report: Callable[[FragmentId], None] | None = None
) -> list[Scan]:
    """All fragments of all stages, in canonical order.

    Every spot draws from a stream of its own, so the same seed gives the same points.

    Args:
        config: everything.
        report: called after each fragment.

    Raises:
        InputError: a stage has no free floor to stand on.
    """
    site = build_floor(config.area, config.site, config.seed)
    return [
        taken
        for stage in range(1, site.stages + 1)
        for taken in _scan_stage(site, stage, config, report)
    ]


def ground_truth_graph(config: SimulationConfig, scans: list[Scan]) -> PoseGraph:
    """True poses, and an edge for every pair that overlaps enough; source before target."""
    clouds = [Cloud(taken.fragment.points) for taken in scans]
    poses = [taken.T_map_fragment for taken in scans]
    edges = []
    for (i, j), figures in all_overlaps(clouds, poses, config.overlap_distance).items():
        if figures.overlap_ratio < config.min_overlap:
            continue
        pair = FragmentPair(scans[i].fragment.id, scans[j].fragment.id)
        edges.append(
            Edge(
                pair,
                relative(poses[i], poses[j]),
                EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE,
                overlap_ratio=figures.overlap_ratio,
                temporal_change=figures.temporal_change,
            )
        )
    nodes = tuple(
        Node(taken.fragment.id, taken.T_map_fragment, NodeStatus.PLACED) for taken in scans
    )
    return PoseGraph(nodes, tuple(edges), name=f"Bldg{config.area}_Graph1")


def bag_metadata(config: SimulationConfig) -> dict[str, str]:
    """How the bag was made: generator, its version, and every setting under its dotted name."""
    metadata = {"generator": "nss simulate", "generator_version": __version__}
    metadata.update(_flat("simulation", config.model_dump()))
    return metadata


def _flat(name: str, value: Any) -> dict[str, str]:
    if not isinstance(value, dict):
        return {name: value if isinstance(value, str) else json.dumps(value)}
    return {
        key: text
        for part, item in value.items()
        for key, text in _flat(f"{name}.{part}", item).items()
    }


def _scan_stage(
    site: Site,
    stage: int,
    config: SimulationConfig,
    report: Callable[[FragmentId], None] | None,
) -> list[Scan]:
    scene = Scene(site.stage_mesh(stage).mesh)
    spots = choose_viewpoints(
        occupancy_map(scene, site.extent, config.viewpoints),
        config.viewpoints,
        config.rig.max_range,
        np.random.default_rng((config.seed, stage, _VIEWPOINT_STREAM)),
    )
    scans = []
    for number, spot in enumerate(spots, start=1):
        rng = np.random.default_rng((config.seed, stage, number, _SCAN_STREAM))
        T_map_fragment = draw_pose(spot, config.rig, rng)
        points = voxelize(scan(scene, T_map_fragment, config.rig, rng), config.voxel_size)
        fragment = Fragment(FragmentId(config.area, stage, number), points, gravity_aligned=True)
        scans.append(Scan(fragment, T_map_fragment))
        if report:
            report(fragment.id)
    return scans
