"""A folder of the NSS release as a bag's content, or as a dataset folder; see `release`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from nss_ros.dataset.annotate import MULTIWAY_FOLDER
from nss_ros.dataset.annotation import PairAnnotation, pair_table
from nss_ros.dataset.challenge import (
    ChallengeEdge,
    ChallengeGraph,
    ChallengeNode,
    edge_pairs,
    ground_truth,
)
from nss_ros.dataset.challenge_folder import ChallengeFolder
from nss_ros.dataset.depth_image import read_depth_image
from nss_ros.dataset.folder import (
    PAIRS_NAME,
    PANORAMA_FOLDER,
    SPLIT_FOLDER,
    DatasetFolder,
    FragmentColumns,
)
from nss_ros.dataset.graphs import write_graph_sets
from nss_ros.dataset.manifest import Manifest, current_versions, write_manifest
from nss_ros.dataset.pairs import write_pairs
from nss_ros.dataset.ply import read_columns
from nss_ros.dataset.refinement import RefinedPair, write_refined
from nss_ros.dataset.release import VOXEL_SIZE, Release
from nss_ros.dataset.site_record import SiteRecord
from nss_ros.dataset.splits import SETS, write_split
from nss_ros.dataset.stage_scan import fitted_normals
from nss_ros.dataset.writer import DatasetWriter
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, inverse, rotation_angle

_RANGE = 4.5
_SAME = 1e-6  # transforms that differ by less are one: files may round them
_SENSOR_HEIGHT = 1.65  # above the floor, metres


def as_challenge(
    release: Release,
    split: str | None = None,
    sets: Sequence[str] = SETS,
    multiway: bool = False,
    graph_pattern: str | None = None,
) -> ChallengeFolder:
    """What a bag takes of a release: the pairs of a split, or its multi-way graphs.

    The pairs of an area become the edges of one graph, Bldg<area>_<split>; each edge has the
    transform of its annotation, each node the pose that is known.

    Args:
        release: as read.
        split: name of a split; None: the first of original, cross_area, cross_stage that there is.
        sets: of "train", "val" and "test".
        multiway: take the multi-way graphs and their edges.
        graph_pattern: shell pattern of the graphs to take, by name; None: all.

    Raises:
        InputError: the release has no such split, or nothing in these sets.
        FormatError: a graph is not valid.
    """
    held = release.graphs if multiway else release.annotations
    what = "multi-way graphs" if multiway else "annotated pairs"
    if not held:
        raise InputError(f"{release.folder} has no {what}: ask for the other kind.")
    name = next(iter(held)) if split is None else split
    if name not in held:
        raise InputError(
            f"{release.folder} has no {what} of the split '{name}': it has {', '.join(held)}."
        )
    if multiway:
        graphs = [graph for each in sets for graph in release.graphs[name].get(each, ())]
    else:
        graphs = _pair_graphs(release, name, sets)
    graphs = [graph for graph in graphs if fnmatch(graph.name, graph_pattern or "*")]
    pairs = _union(graphs)
    if not pairs:
        raise InputError(
            f"{release.folder} has no {what} in {', '.join(sets)} of the split '{name}'"
            f"{f' that match {graph_pattern}' if graph_pattern else ''}: take other sets."
        )
    truths = tuple(ground_truth(graph) for graph in graphs)
    used = sorted({node.id for truth in truths for node in truth.nodes})
    files = {id_: release.point_files[id_] for id_ in used}
    return ChallengeFolder(tuple(graphs), truths, pairs, files)


def as_dataset(
    release: Release,
    output: Path,
    gravity_aligned: bool = False,
    report: Callable[[int, int], None] | None = None,
) -> tuple[DatasetFolder, tuple[str, ...]]:
    """Make a dataset folder of a release; one that was cut short is completed.

    Relative transforms that differ from the poses are kept as refined pairs. Poses that the
    release does not tell follow from its relative transforms; an area without any
    gets the frame of one of its fragments. Normals that its point clouds lack are fitted.

    Args:
        release: as read.
        output: folder to create or to complete.
        gravity_aligned: z points up in every fragment; a release of ours says it itself.
        report: called with how many fragments are done, and how many there are.

    Returns:
        The dataset, and one sentence for each area whose fragments are not all in it, since
        nothing links them.

    Raises:
        InputError: the output holds something else.
        FormatError: a file cannot be read or written, or a fragment's points are not finite.
    """
    poses, sentences = _all_poses(release)
    manifest = _manifest(release, gravity_aligned)
    writer = DatasetWriter(
        output, manifest, panoramas=poses.keys() <= release.panorama_files.keys()
    )
    if release.panorama_files:  # perhaps not of all
        (output / PANORAMA_FOLDER).mkdir(exist_ok=True)
    done = 0
    for area in dict.fromkeys(id_.area for id_ in poses):
        members = [id_ for id_ in poses if id_.area == area]
        writer.begin_area(_site(release, area, [poses[id_] for id_ in members], members), {})
        there = writer.done(area)
        for id_ in members:
            if id_ not in there:
                file = release.panorama_files.get(id_)
                image = None if file is None else read_depth_image(file)
                writer.append(id_, poses[id_], _columns(release.point_files[id_]), image)
            done += 1
            if report:
                report(done, len(poses))
        writer.finish_area(area)
    writer.finish()
    dataset = DatasetFolder(output)
    _add_pairs(dataset, release, poses)
    if refined := _refined(release, poses):
        write_refined(output, refined)
    for split, sets in release.graphs.items():
        write_graph_sets(output / MULTIWAY_FOLDER / split, sets)
    return dataset, sentences


def _pair_graphs(release: Release, split: str, sets: Sequence[str]) -> list[ChallengeGraph]:
    annotations = [each for name in sets for each in release.annotations[split].get(name, ())]
    graphs = []
    for area in sorted({each.pair.source.area for each in annotations}):
        own = [each for each in annotations if each.pair.source.area == area]
        ids = sorted({id_ for each in own for id_ in (each.pair.source, each.pair.target)})
        numbers = {id_: number for number, id_ in enumerate(ids)}
        nodes = tuple(
            ChallengeNode(numbers[id_], f"{id_}.ply", release.poses.get(id_)) for id_ in ids
        )
        edges = tuple(
            ChallengeEdge(
                numbers[each.pair.source],
                numbers[each.pair.target],
                each.T_target_source,
                each.pair.same_stage,
                each.overlap_ratio,
                each.temporal_change,
            )
            for each in own
        )
        graphs.append(ChallengeGraph(f"Bldg{area}_{split}", nodes, edges, str(release.folder)))
    return graphs


def _union(graphs: Iterable[ChallengeGraph]) -> tuple[FragmentPair, ...]:
    union: dict[frozenset[FragmentId], FragmentPair] = {}
    for graph in graphs:
        for pair in edge_pairs(graph):
            union.setdefault(frozenset((pair.source, pair.target)), pair)
    return tuple(union.values())


def _all_annotations(release: Release) -> list[PairAnnotation]:
    """Every two fragments once, in canonical order of the pairs."""
    found: dict[frozenset[FragmentId], PairAnnotation] = {}
    for sets in release.annotations.values():
        for part in sets.values():
            for each in part:
                found.setdefault(frozenset((each.pair.source, each.pair.target)), each)
    return sorted(found.values(), key=lambda each: each.pair)


def _graph_annotations(release: Release) -> list[PairAnnotation]:
    """The edges of the multi-way graphs as annotations, those with a transform and an overlap."""
    return [
        PairAnnotation(edge.pair, edge.T_target_source, edge.overlap_ratio, edge.temporal_change)
        for sets in release.graphs.values()
        for part in sets.values()
        for graph in part
        for edge in ground_truth(graph).edges
        if np.isfinite(edge.overlap_ratio)
    ]


def _all_poses(release: Release) -> tuple[dict[FragmentId, Transform], tuple[str, ...]]:
    """Poses told, and those that follow from them or from a fragment of the area."""
    links: dict[FragmentId, list[tuple[FragmentId, Transform]]] = {}
    for each in _all_annotations(release):
        source, target = each.pair.source, each.pair.target
        links.setdefault(target, []).append((source, each.T_target_source))
        links.setdefault(source, []).append((target, inverse(each.T_target_source)))
    poses = dict(release.poses)
    _spread(poses, links)
    sentences = []
    for area in dict.fromkeys(id_.area for id_ in release.point_files):
        members = [id_ for id_ in release.point_files if id_.area == area]
        if not any(id_ in poses for id_ in members):
            largest = max((_component(id_, links) for id_ in members), key=len)
            poses |= largest
        lost = sum(id_ not in poses for id_ in members)
        if lost:
            sentences.append(
                f"Area {area}: {lost} fragments are left out, since neither a pose nor a pair "
                "links them to the others."
            )
    return dict(sorted(poses.items())), tuple(sentences)


def _component(
    start: FragmentId, links: dict[FragmentId, list[tuple[FragmentId, Transform]]]
) -> dict[FragmentId, Transform]:
    poses = {start: np.eye(4)}
    _spread(poses, links)
    return poses


def _spread(
    poses: dict[FragmentId, Transform],
    links: dict[FragmentId, list[tuple[FragmentId, Transform]]],
) -> None:
    """Place what is linked to what is placed, nearest in number of links first."""
    waiting = list(poses)
    for here in waiting:  # grows
        for other, T_here_other in links.get(here, ()):
            if other not in poses:
                poses[other] = poses[here] @ T_here_other
                waiting.append(other)


def _columns(path: Path) -> FragmentColumns:
    table = read_columns(path)
    points = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float32)
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad or len(points) == 0:
        raise FormatError(
            f"{path} holds {bad} points that are not finite: copy or export the file again."
            if bad
            else f"{path} holds no point: copy or export the file again."
        )
    if all(name in table for name in ("nx", "ny", "nz")):
        normals = np.column_stack([table[name] for name in ("nx", "ny", "nz")])
    else:
        normals = fitted_normals(points.astype(np.float64))
        away = np.einsum("ni,ni->n", normals, points) > 0
        normals = np.where(away[:, None], -normals, normals)  # towards the sensor, the origin
    return FragmentColumns(points, normals.astype(np.float32))


def _manifest(release: Release, gravity_aligned: bool) -> Manifest:
    if release.manifest is None:
        return Manifest(
            seed=0,
            simulation={"voxel_size": VOXEL_SIZE},
            labels=False,
            gravity_aligned=gravity_aligned,
            versions=current_versions(),
        )
    before = release.manifest
    steps = {name: made for name, made in before.steps.items() if name == "pairs"}
    return before.model_copy(
        update={"labels": False, "complete": False, "areas": {}, "steps": steps}
    )


def _site(
    release: Release, area: str, poses: Sequence[Transform], members: Sequence[FragmentId]
) -> SiteRecord:
    """The little that is known of an area: its stages, and about where it is."""
    known = release.manifest.areas.get(area) if release.manifest else None
    names = [stage.name for stage in known.stages] if known else []
    stages = max(len(names), *(id_.stage for id_ in members))
    places = np.array([pose[:3, 3] for pose in poses])
    low, high = places.min(axis=0) - _RANGE, places.max(axis=0) + _RANGE
    return SiteRecord(
        area=area,
        stages=stages,
        stage_names=[*names, *[""] * (stages - len(names))],
        extent=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        floor_height=float(np.median(places[:, 2]) - _SENSOR_HEIGHT),
        elements=[],
    )


def _refined(
    release: Release, poses: dict[FragmentId, Transform]
) -> dict[FragmentPair, RefinedPair]:
    """Annotated transforms that say something else than the poses: they were refined."""
    found = {}
    for each in _all_annotations(release):
        source, target = each.pair.source, each.pair.target
        if source not in poses or target not in poses:
            continue
        correction = poses[target] @ each.T_target_source @ inverse(poses[source])
        if np.abs(correction - np.eye(4)).max() > _SAME:
            middle = (poses[source][:3, 3] + poses[target][:3, 3]) / 2
            moved = correction[:3, :3] @ middle + correction[:3, 3] - middle
            found[each.pair] = RefinedPair(
                each.T_target_source,
                reason="",
                translation=float(np.linalg.norm(moved)),
                rotation=rotation_angle(correction),
                rmse=math.nan,
                correspondences=0,
                deviation=math.inf,
            )
    return found


def _add_pairs(
    dataset: DatasetFolder, release: Release, poses: dict[FragmentId, Transform]
) -> None:
    """Write pairs and splits as the release has them, and say so in the manifest."""

    def placed(annotations: Iterable[PairAnnotation]) -> list[PairAnnotation]:
        return [a for a in annotations if a.pair.source in poses and a.pair.target in poses]

    chosen = placed(_all_annotations(release))
    known = {frozenset((each.pair.source, each.pair.target)) for each in chosen}
    more: dict[frozenset[FragmentId], PairAnnotation] = {}
    for each in placed(_graph_annotations(release)):
        key = frozenset((each.pair.source, each.pair.target))
        if key not in known:
            more.setdefault(key, each)
    both = pair_table([*chosen, *more.values()])
    selected = np.arange(len(both)) < len(chosen)
    order = sorted(range(len(both)), key=both.pairs.__getitem__)
    table = both.select(selected).take(np.array(order, dtype=np.int64))
    write_pairs(dataset.path / PAIRS_NAME, table)
    for split, sets in release.annotations.items():
        tables = {name: pair_table(placed(sets.get(name, ()))) for name in SETS}
        write_split(dataset.path / SPLIT_FOLDER / split, tables)
    before = dataset.manifest.steps.get("pairs", {})
    step = {"seed": 0} | before | {"imported": True}
    steps = dataset.manifest.steps | {"pairs": step}
    dataset.manifest = dataset.manifest.model_copy(update={"steps": steps})
    write_manifest(dataset.path, dataset.manifest)
