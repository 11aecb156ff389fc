"""A dataset as a bag: fragments, pairs and, on a topic of its own, the ground truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nss_ros.bag import write_bag
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.pairs import PairTable
from nss_ros.dataset.refinement import refined_transforms
from nss_ros.fragment import Fragment
from nss_ros.geometry import relative
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph


def export_bag(
    path: Path, dataset: DatasetFolder, pairs: PairTable, min_overlap: float
) -> PairTable:
    """Write all fragments of a dataset, in canonical order, and the pairs that overlap enough.

    Ground truth of a pair is its refined transform, or else that of the poses.

    Args:
        path: folder to create.
        dataset: complete.
        pairs: of the dataset.
        min_overlap: least overlap ratio of a pair.

    Returns:
        The pairs in the bag.

    Raises:
        BagError: the folder exists or cannot be written.
        FormatError: a fragment cannot be read.
    """
    chosen = pairs.take(pairs.overlap_ratio >= min_overlap)
    graphs = [ground_truth_graph(dataset, area, chosen) for area in dataset.areas()]
    write_bag(path, _fragments(dataset), chosen.pairs, graphs, dataset_metadata(dataset))
    return chosen


def _fragments(dataset: DatasetFolder) -> Iterator[Fragment]:
    return (dataset.fragment(id_) for id_ in dataset.fragment_ids())


def ground_truth_graph(dataset: DatasetFolder, area: str, pairs: PairTable) -> PoseGraph:
    """True poses of an area's fragments, and an edge for each of its pairs."""
    refined = refined_transforms(dataset.path)
    poses = {id_: pose for id_, pose in dataset.poses().items() if id_.area == area}
    rows = pairs.take(np.array([id_.area == area for id_ in pairs.source], dtype=bool))
    edges = tuple(
        Edge(
            pair,
            refined[pair] if pair in refined else relative(poses[pair.source], poses[pair.target]),
            EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE,
            overlap_ratio=float(overlap),
            temporal_change=float(change),
        )
        for pair, overlap, change in zip(
            rows.pairs, rows.overlap_ratio, rows.temporal_change, strict=True
        )
    )
    nodes = tuple(Node(id_, pose, NodeStatus.PLACED) for id_, pose in poses.items())
    return PoseGraph(nodes, edges, name=f"Bldg{area}_Graph1")


def export_fragments(path: Path, dataset: DatasetFolder) -> None:
    """Write all fragments of a dataset, in canonical order, as a bag without pairs and truth.

    Raises:
        BagError: the folder exists or cannot be written.
        FormatError: a fragment cannot be read.
    """
    write_bag(path, _fragments(dataset), (), (), dataset_metadata(dataset))


def dataset_metadata(dataset: DatasetFolder) -> dict[str, str]:
    """How the dataset was made: every setting under its dotted name."""
    manifest = dataset.manifest
    told = {"simulation": manifest.simulation, "sites": manifest.sites, "steps": manifest.steps}
    metadata = {"generator": "nss simulate", "generator_seed": str(manifest.seed)}
    for name, value in told.items():
        metadata |= _flat(name, value)
    return metadata | {f"generator_version.{k}": v for k, v in manifest.versions.items()}


def _flat(name: str, value: Any) -> dict[str, str]:
    if not isinstance(value, dict):
        return {name: value if isinstance(value, str) else json.dumps(value)}
    return {
        key: text
        for part, item in value.items()
        for key, text in _flat(f"{name}.{part}", item).items()
    }
