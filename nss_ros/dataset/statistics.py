"""The tables of a dataset, as the NSS paper gives them (Sun et al. 2023, arXiv 2311.09346).

Areas with their stages and floor; pairs within and between stages; splits; multi-way graphs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from nss_ros.dataset.annotate import MULTIWAY_FOLDER
from nss_ros.dataset.challenge import ground_truth, read_graphs
from nss_ros.dataset.folder import GRAPH_FOLDER, PAIRS_NAME, SPLIT_FOLDER, DatasetFolder
from nss_ros.dataset.footprint import floor_area
from nss_ros.dataset.pairs import PairTable, read_pairs
from nss_ros.dataset.splits import SETS, Split
from nss_ros.fragment import FragmentId, Points
from nss_ros.geometry import Transform
from nss_ros.multiway.pose_graph import EdgeKind, NodeStatus, PoseGraph
from nss_ros.table import Align, Cell, Column, Table

MIN_OVERLAP = 0.1
"""Overlap ratio from which the paper counts pairs."""

_TOTAL = "total"


def dataset_tables(
    dataset: DatasetFolder, report: Callable[[FragmentId], None] | None = None
) -> dict[str, Table]:
    """All tables of a dataset for which there are data, by name, in the order of reading.

    Args:
        dataset: with or without pairs, splits and graphs.
        report: called after each fragment that was read.

    Raises:
        FormatError: a file of the dataset is damaged.
    """
    tables = {"areas": area_table(dataset, report)}
    if (dataset.path / PAIRS_NAME).exists():
        tables["pairs"] = pair_table(read_pairs(dataset.path / PAIRS_NAME))
    if (dataset.path / SPLIT_FOLDER).is_dir():
        tables["splits"] = split_table(dataset)
    graphs = graph_table(dataset)
    return tables | {"graphs": graphs} if graphs.rows else tables


def area_table(dataset: DatasetFolder, report: Callable[[FragmentId], None] | None = None) -> Table:
    """Stages, floor area, fragments and points of each area.

    The floor area is what the fragments of all stages have seen; see `footprint`.

    Args:
        dataset: any.
        report: called after each fragment that was read.

    Raises:
        FormatError: a file of the dataset is damaged.
    """
    rows: list[tuple[Cell, ...]] = []
    floor, sizes = 0.0, list[int]()
    for area in dataset.areas():
        ids = dataset.fragment_ids(area)
        here = list[int]()
        seen = floor_area(_placed_points(dataset, ids, here, report))
        stages = len(dataset.manifest.areas[area].stages)
        per_stage = [sum(id_.stage == stage for id_ in ids) for stage in range(1, stages + 1)]
        by_stage = " + ".join(str(count) for count in per_stage)
        rows.append((area, stages, seen, len(ids), by_stage, _mean(here)))
        floor, sizes = floor + seen, sizes + here
    if len(rows) > 1:
        stages = sum(len(record.stages) for record in dataset.manifest.areas.values())
        rows.append((_TOTAL, stages, floor, len(sizes), None, _mean(sizes)))
    return Table(
        "Areas",
        (
            Column("area", align=Align.LEFT),
            Column("stages"),
            Column("floor area", "m²", ",.0f"),
            Column("fragments", form=","),
            Column("by stage"),
            Column("points per fragment", form=",.0f"),
        ),
        tuple(rows),
        "Floor area: seen by the fragments of any stage, in cells of 0.25 m.",
    )


def pair_table(pairs: PairTable) -> Table:
    """Pairs of each area within and between stages: overlapping, from 0.1, and selected."""
    areas = np.array([id_.area for id_ in pairs.source], dtype=object)
    same = pairs.same_stage
    overlapping = np.ones(len(pairs), dtype=bool)
    masks = (overlapping, pairs.overlap_ratio >= MIN_OVERLAP, pairs.selected)
    rows = [(area, *_by_kind(masks, same, areas == area)) for area in dict.fromkeys(areas)]
    if len(rows) > 1:
        rows.append((_TOTAL, *_by_kind(masks, same, overlapping)))
    return Table(
        "Pairs",
        (
            Column("area", align=Align.LEFT),
            *(
                Column(f"{which}, {kind}", form=",")
                for which in ("overlapping", f"OR >= {MIN_OVERLAP}", "selected")
                for kind in ("same stage", "different stages")
            ),
        ),
        tuple(rows),
        "OR: overlap ratio, from source to target.",
    )


def split_table(dataset: DatasetFolder) -> Table:
    """Pairs of each split's sets within and between stages.

    Raises:
        FormatError: a file of the dataset is damaged.
    """
    rows: list[tuple[Cell, ...]] = []
    for split in Split:
        for name in SETS:
            path = dataset.path / SPLIT_FOLDER / split / f"{name}.csv"
            if path.exists():
                pairs = read_pairs(path)
                same = int(pairs.same_stage.sum())
                fragments = {*pairs.source, *pairs.target}
                different = len(pairs) - same
                rows.append((str(split), name, len(fragments), same, different, len(pairs)))
    return Table(
        "Splits",
        (
            Column("split", align=Align.LEFT),
            Column("set", align=Align.LEFT),
            Column("fragments", form=","),
            Column("pairs, same stage", form=","),
            Column("pairs, different stages", form=","),
            Column("pairs", form=","),
        ),
        tuple(rows),
        "Selected pairs.",
    )


def graph_table(dataset: DatasetFolder) -> Table:
    """The pose graphs of each set: those of the challenge's kind, and those of whole areas.

    Raises:
        FormatError: a file of the dataset is damaged.
    """
    rows: list[tuple[Cell, ...]] = []
    for kind, root in (("challenge", GRAPH_FOLDER), ("multi-way", MULTIWAY_FOLDER)):
        sets: dict[str, list[PoseGraph]] = {}
        for file in sorted((dataset.path / root).rglob("*.json")):
            parts = file.parent.relative_to(dataset.path / root).parts
            name = " ".join(dict.fromkeys(parts))  # "all" once
            sets.setdefault(name, []).extend(ground_truth(graph) for graph in read_graphs(file))
        order = sorted(sets, key=lambda name: (name.split()[:-1], _place(name)))
        rows += [(kind, name or None, *_graph_cells(sets[name])) for name in order]
    return Table(
        "Pose graphs",
        (
            Column("kind", align=Align.LEFT),
            Column("set", align=Align.LEFT),
            Column("graphs", form=","),
            Column("nodes", form=","),
            Column("nodes per graph"),
            Column("edges, same stage", form=","),
            Column("edges, different stages", form=","),
            Column("mean overlap ratio", form=".2f"),
            Column("outlier nodes", form=","),
        ),
        tuple(rows),
    )


def _place(name: str) -> int:
    """Train comes before val and test; others stand first."""
    last = name.split()[-1:]
    return SETS.index(last[0]) + 1 if last and last[0] in SETS else 0


def _placed_points(
    dataset: DatasetFolder,
    ids: list[FragmentId],
    sizes: list[int],
    report: Callable[[FragmentId], None] | None,
) -> Iterator[tuple[Points, Transform]]:
    """Points and poses of fragments; their numbers of points are noted in `sizes`."""
    poses = dataset.poses()
    for id_ in ids:
        points = dataset.fragment(id_).points
        sizes.append(len(points))
        yield points, poses[id_]
        if report:
            report(id_)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _by_kind(
    masks: tuple[NDArray[np.bool_], ...], same: NDArray[np.bool_], where: NDArray[np.bool_]
) -> list[int]:
    return [int((mask & where & kind).sum()) for mask in masks for kind in (same, ~same)]


def _graph_cells(graphs: list[PoseGraph]) -> tuple[Cell, ...]:
    sizes = [len(graph.nodes) for graph in graphs]
    edges = [edge for graph in graphs for edge in graph.edges]
    same = sum(edge.kind is EdgeKind.SAME_STAGE for edge in edges)
    overlaps = [edge.overlap_ratio for edge in edges if np.isfinite(edge.overlap_ratio)]
    outliers = sum(node.status is NodeStatus.OUTLIER for graph in graphs for node in graph.nodes)
    span = f"{min(sizes)}-{max(sizes)}" if min(sizes) < max(sizes) else str(sizes[0])
    return len(graphs), sum(sizes), span, same, len(edges) - same, _mean(overlaps), outliers
