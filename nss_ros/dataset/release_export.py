"""A dataset in the layout of the NSS release; see `release`."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nss_ros.config import GraphConfig
from nss_ros.dataset.annotate import MULTIWAY_FOLDER, pair_sets
from nss_ros.dataset.annotation import PairAnnotation, write_annotations
from nss_ros.dataset.challenge import ChallengeGraph, read_graphs, write_graphs_2024
from nss_ros.dataset.folder import (
    POSES_NAME,
    SPLIT_FOLDER,
    DatasetFolder,
    FragmentColumns,
    panorama_file,
    write_fragment_columns,
)
from nss_ros.dataset.graphs import multiway_graphs
from nss_ros.dataset.manifest import write_json
from nss_ros.dataset.pairs import PairTable, read_pairs
from nss_ros.dataset.ply import count_vertices
from nss_ros.dataset.pose_file import write_poses
from nss_ros.dataset.refinement import refined_transforms
from nss_ros.dataset.release import ANNOTATIONS, MANIFEST, MULTIWAY, PANORAMAS, POINTS, VOXEL_SIZE
from nss_ros.dataset.splits import SETS, Split
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair, occupied_voxels, voxel_means
from nss_ros.geometry import Transform, relative


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        fragments: their number.
        panoramas: likewise.
        pairs: number by split and set.
        graphs: likewise.
        skipped: one sentence for each set that has no multi-way graph.
    """

    fragments: int
    panoramas: int
    pairs: dict[str, dict[str, int]]
    graphs: dict[str, dict[str, int]]
    skipped: tuple[str, ...]


def export_release(
    dataset: DatasetFolder,
    output: Path,
    config: GraphConfig,
    report: Callable[[int, int], None] | None = None,
) -> Exported:
    """Write a dataset as the NSS release is laid out.

    Pairs are those that `nss pairs` selected for each set, with the transform that `nss refine`
    gave or else that of the poses. Multi-way graphs are those that `nss
    graphs --kind multiway` made of a split, else they are made here. Points come with their
    normals; labels stay behind, the release has none.

    Args:
        dataset: complete, with pairs.
        output: folder to create.
        config: of the multi-way graphs that are made here.
        report: called with how many fragments are written, and how many there are.

    Raises:
        InputError: the folder exists, or the dataset is not complete or has no pairs.
        FormatError: a file cannot be read or written, or a fragment's points are not finite.
    """
    if not dataset.manifest.complete:
        raise InputError(
            f"{dataset.path} is not complete: finish it with the 'nss simulate' that began it."
        )
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output} exists already: choose another name or remove it.")
    splits = _splits(dataset)
    poses = dataset.poses()
    refined = refined_transforms(dataset.path)
    graphs, skipped = _graphs(dataset, list(splits), config)
    panoramas = _write_fragments(dataset, output, report)
    for split, sets in splits.items():
        for name, pairs in sets.items():
            path = _made(output / ANNOTATIONS / split) / f"{name}.json"
            write_annotations(path, _annotations(pairs, poses, refined))
    for split, parts in graphs.items():
        for name, part in parts.items():
            write_graphs_2024(_made(output / MULTIWAY / split) / f"{name}.json", part)
    write_poses(output / POSES_NAME, poses)
    write_json(output / MANIFEST, dataset.manifest.model_dump(mode="json"))
    return Exported(
        len(poses),
        panoramas,
        {split: {name: len(each) for name, each in sets.items()} for split, sets in splits.items()},
        {split: {name: len(each) for name, each in s.items()} for split, s in graphs.items()},
        tuple(skipped),
    )


def _splits(dataset: DatasetFolder) -> dict[str, dict[str, PairTable]]:
    """The selected pairs of each split that the dataset has."""
    folder = dataset.path / SPLIT_FOLDER
    splits = {
        split.value: {
            name: read_pairs(folder / split / f"{name}.csv")
            for name in SETS
            if (folder / split / f"{name}.csv").exists()
        }
        for split in Split
    }
    splits = {split: sets for split, sets in splits.items() if sets}
    if not splits:
        raise InputError(f"{dataset.path} has no splits yet: run 'nss pairs {dataset.path}' first.")
    return splits


def _annotations(
    pairs: PairTable, poses: dict[FragmentId, Transform], refined: dict[FragmentPair, Transform]
) -> list[PairAnnotation]:
    return [
        PairAnnotation(
            pair,
            refined[pair] if pair in refined else relative(poses[pair.source], poses[pair.target]),
            *figures,
        )
        for pair, *figures in zip(
            pairs.pairs,
            pairs.overlap_ratio.tolist(),
            pairs.temporal_change.tolist(),
            pairs.reverse_overlap_ratio.tolist(),
            pairs.source_complexity.tolist(),
            pairs.target_complexity.tolist(),
            strict=True,
        )
    ]


def _graphs(
    dataset: DatasetFolder, splits: list[str], config: GraphConfig
) -> tuple[dict[str, dict[str, list[ChallengeGraph]]], list[str]]:
    poses = dataset.poses()
    counts: dict[FragmentId, int] = {}
    found: dict[str, dict[str, list[ChallengeGraph]]] = {}
    skipped: list[str] = []
    for split in splits:
        folder = dataset.path / MULTIWAY_FOLDER / split
        if folder.is_dir():
            found[split] = {
                name: [
                    g for file in sorted((folder / name).glob("*.json")) for g in read_graphs(file)
                ]
                for name in SETS
            }
            continue
        counts = counts or {id_: count_vertices(dataset.point_file(id_)) for id_ in poses}
        sets = pair_sets(dataset, Split(split))
        refined = refined_transforms(dataset.path)
        made = multiway_graphs(sets, poses, config, counts, "Multiway", refined)
        found[split] = made.graphs
        skipped += [f"Split {split}: {sentence}" for sentence in made.skipped]
    return found, skipped


def _write_fragments(
    dataset: DatasetFolder, output: Path, report: Callable[[int, int], None] | None
) -> int:
    """Write points and panoramas; how many panoramas there are."""
    ids = dataset.fragment_ids()
    points = _made(output / POINTS)
    panoramas = 0
    for done, id_ in enumerate(ids, start=1):
        columns = _release_columns(dataset.columns(id_), dataset, id_)
        write_fragment_columns(points / f"{id_}.ply", columns)
        image = panorama_file(dataset.path, id_)
        if image.exists():
            shutil.copyfile(image, _made(output / PANORAMAS) / f"{id_}.png")
            panoramas += 1
        if report:
            report(done, len(ids))
    return panoramas


def _release_columns(
    columns: FragmentColumns, dataset: DatasetFolder, id_: FragmentId
) -> FragmentColumns:
    """Points and normals, in voxels of the release's size if they are finer than that."""
    bad = int((~np.isfinite(columns.points).all(axis=1)).sum())
    if bad:
        raise FormatError(
            f"{dataset.point_file(id_)} holds {bad} points that are not finite: make it again with "
            "'nss simulate' and the same settings."
        )
    size = dataset.manifest.simulation.get("voxel_size")
    if size is not None and size >= VOXEL_SIZE:
        return FragmentColumns(columns.points, columns.normals)
    voxels, count = occupied_voxels(columns.points, VOXEL_SIZE)
    if count == len(columns.points):
        return FragmentColumns(columns.points, columns.normals)
    normals = voxel_means(columns.normals, voxels, count)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.unique(voxels, return_index=True)[1]
    # Both sides of a thin board may cancel out.
    normals = np.where(lengths > 0.1, normals / np.maximum(lengths, 0.1), columns.normals[first])
    return FragmentColumns(voxel_means(columns.points, voxels, count), normals.astype(np.float32))


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"Cannot make the folder {folder}: {error.strerror}.") from error
    return folder
