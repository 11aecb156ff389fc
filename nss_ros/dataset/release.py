"""A folder in the layout of the NSS release: clouds, panoramas, and annotations of three splits.

    pointclouds/<id>.ply                                   x y z, voxels of 0.075 m, sensor frame
    panoramas/<id>.png                                     16-bit depth; may be missing
    annotations/<split>/{train,val,test}.json              pairs, see `annotation`
    annotations_multiway/<split>/{train,val,test}.json     lists of pose graphs, see `challenge`

Splits are `original`, `cross_area` and `cross_stage`. That there are `pointclouds`, `annotation`
and `annotation_multiway` with a folder `original` is said in the README of the challenge of 2024
(GradientSpaces/nss-challenge); point clouds of 0.075 m in that of 2025; panoramas of 10 m full
scale in its `pan_to_pcd.py`. Names inside the archives are not documented where we could read
them, so those that are in use elsewhere are read as well: `point_cloud`, `annotation`,
`<set>.pose_graph.json`, `<id>.450.ply`.

We add `poses.jsonl` with the pose of every fragment, in graphs or not, and `nss_ros.json` with
the dataset's manifest, so that importing what was exported gives the same dataset. Both may be
missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from nss_ros.dataset.annotation import PairAnnotation, fragment_of, pair_table, read_annotations
from nss_ros.dataset.challenge import ChallengeGraph, ground_truth, read_graphs
from nss_ros.dataset.folder import POSES_NAME
from nss_ros.dataset.manifest import Manifest
from nss_ros.dataset.pose_file import read_poses
from nss_ros.dataset.splits import SETS, Split
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform
from nss_ros.multiway.pose_graph import NodeStatus

POINTS, PANORAMAS = "pointclouds", "panoramas"
ANNOTATIONS, MULTIWAY = "annotations", "annotations_multiway"
MANIFEST = "nss_ros.json"
VOXEL_SIZE = 0.075
"""Of the release's point clouds, metres."""

_POINT_NAMES = (POINTS, "pointcloud", "point_clouds", "point_cloud")
_PANORAMA_NAMES = (PANORAMAS, "panorama")
_ANNOTATION_NAMES = (ANNOTATIONS, "annotation")
_MULTIWAY_NAMES = (MULTIWAY, "annotation_multiway")

Annotations = Mapping[str, Mapping[str, Sequence[PairAnnotation]]]
Graphs = Mapping[str, Mapping[str, Sequence[ChallengeGraph]]]


@dataclass(frozen=True, slots=True)
class Release:
    """What a folder of the release holds; point clouds are located, not yet read.

    Attributes:
        folder: where it is.
        point_files: of every fragment that is annotated, in canonical order.
        panorama_files: of those that have one.
        annotations: pairs by split and set.
        graphs: multi-way pose graphs by split and set.
        poses: `T_map_fragment` as far as told, one map frame per area.
        manifest: of the dataset that it was exported from, if it was.
    """

    folder: Path
    point_files: dict[FragmentId, Path]
    panorama_files: dict[FragmentId, Path]
    annotations: Annotations
    graphs: Graphs
    poses: dict[FragmentId, Transform]
    manifest: Manifest | None

    def splits(self) -> list[str]:
        """Names of the splits that have pairs or graphs."""
        return sorted({*self.annotations, *self.graphs}, key=_split_order)


def is_release(folder: Path) -> bool:
    """Whether a folder is laid out as the release is: it has annotations."""
    return any((folder / name).is_dir() for name in (*_ANNOTATION_NAMES, *_MULTIWAY_NAMES))


def read_release(folder: Path) -> Release:
    """Read and check all but the points and panoramas of a release.

    Raises:
        InputError: there is no such folder, or it holds no annotation.
        FormatError: a file is not valid, or a point cloud is missing; names it.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}: give a folder of the NSS release.")
    places = {
        kind: _place(folder, names)
        for kind, names in (
            (POINTS, _POINT_NAMES),
            (PANORAMAS, _PANORAMA_NAMES),
            (ANNOTATIONS, _ANNOTATION_NAMES),
            (MULTIWAY, _MULTIWAY_NAMES),
        )
    }
    if places[POINTS] is None:
        raise InputError(f"{folder} has no folder '{POINTS}': put the release's clouds there.")
    annotations = {
        split: {name: _annotations(files) for name, files in sets.items()}
        for split, sets in _set_files(places[ANNOTATIONS]).items()
    }
    graphs = {
        split: {name: [g for file in files for g in read_graphs(file)] for name, files in s.items()}
        for split, s in _set_files(places[MULTIWAY]).items()
    }
    used = _fragments(annotations, graphs)
    if not used:
        raise InputError(
            f"{folder} annotates no fragment: expected pairs in {ANNOTATIONS}/<split>/<set>.json, "
            f"or graphs in {MULTIWAY}/<split>/<set>.json."
        )
    poses = _poses(folder, graphs)
    clouds = _files(places[POINTS], ".ply")
    for id_ in sorted(used | set(poses)):
        if id_ not in clouds:
            raise FormatError(
                f"The point cloud {id_}.ply is missing in {places[POINTS]}, but it is annotated: "
                "copy it there."
            )
    panoramas = _files(places[PANORAMAS], ".png")
    return Release(
        folder,
        {id_: clouds[id_] for id_ in sorted(used | set(poses))},
        {id_: file for id_, file in sorted(panoramas.items()) if id_ in used or id_ in poses},
        annotations,
        graphs,
        poses,
        _manifest(folder / MANIFEST),
    )


def _place(folder: Path, names: Sequence[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def _set_files(place: Path | None) -> dict[str, dict[str, list[Path]]]:
    """The files of each split and set: `<split>/<set>.json`, `<set>.*.json` or `<set>/*.json`."""
    found: dict[str, dict[str, list[Path]]] = {}
    if place is None:
        return found
    for split in sorted((each for each in place.iterdir() if each.is_dir()), key=_folder_order):
        for name in SETS:
            files = sorted(split.glob(f"{name}.json")) or sorted(split.glob(f"{name}.*.json"))
            files += sorted((split / name).glob("*.json"))
            if files:
                found.setdefault(split.name, {})[name] = files
    return found


def _folder_order(folder: Path) -> tuple[int, str]:
    return _split_order(folder.name)


def _split_order(name: str) -> tuple[int, str]:
    known = list(Split)
    return (known.index(Split(name)) if name in known else len(known), name)


def _annotations(files: Sequence[Path]) -> list[PairAnnotation]:
    pairs = [each for file in files for each in read_annotations(file)]
    try:
        pair_table(pairs)
    except InputError as error:
        raise FormatError(f"The pairs of {files[0]} are not valid: {error}") from error
    return pairs


def _fragments(annotations: Annotations, graphs: Graphs) -> set[FragmentId]:
    pairs = [each.pair for s in annotations.values() for part in s.values() for each in part]
    nodes = [
        node.id
        for sets in graphs.values()
        for part in sets.values()
        for graph in part
        for node in ground_truth(graph).nodes  # checks the edges, too
    ]
    return {*nodes, *(pair.source for pair in pairs), *(pair.target for pair in pairs)}


def _poses(folder: Path, graphs: Graphs) -> dict[FragmentId, Transform]:
    """Of our own file, or else of the graphs; of several graphs the first tells."""
    if (folder / POSES_NAME).exists():
        return read_poses(folder / POSES_NAME)
    poses: dict[FragmentId, Transform] = {}
    for sets in graphs.values():
        for part in sets.values():
            for graph in part:
                for node in ground_truth(graph).nodes:
                    if node.status is NodeStatus.PLACED:
                        poses.setdefault(node.id, node.T_map_fragment)
    return dict(sorted(poses.items()))


def _files(place: Path | None, ending: str) -> dict[FragmentId, Path]:
    """The files of a folder by the fragment that they are named after; others are not ours."""
    files: dict[FragmentId, Path] = {}
    for path in sorted(place.glob(f"*{ending}")) if place else ():
        try:
            files.setdefault(fragment_of(path.name.removesuffix(ending)), path)
        except InputError:
            continue
    return files


def _manifest(path: Path) -> Manifest | None:
    if not path.exists():
        return None
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise FormatError(
            f"{path} is not a manifest of this version of nss_ros: remove it to import the "
            "release without it."
        ) from error
