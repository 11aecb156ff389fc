"""The dataset folder: fragments with their ground truth and how they were made.

    manifest.json             every setting and seed, the areas, their stages and sources
    point_cloud/<id>.ply      x y z nx ny nz float32; with labels element int32, change uint8
    panorama/<id>.png         depth panoramas, if asked for
    poses.jsonl               T_map_fragment of every fragment
    sites/<area>.json         the elements that `element` counts, and when each is there
    pairs.csv, splits/        from 'nss pairs'
    pose_graph/               from 'nss graphs', in the layout of the challenge

`change` has two bits: 1, what is under the point was not there at the stage before; 2, it is
gone at the next. For any other stage, `DatasetFolder.changed` tells from `element`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nss_ros.dataset.depth_image import read_depth_image, write_depth_image
from nss_ros.dataset.manifest import Manifest, read_manifest
from nss_ros.dataset.ply import read_columns, write_ply
from nss_ros.dataset.pose_file import read_poses
from nss_ros.dataset.site_record import SiteRecord, read_site
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import Fragment, FragmentId, Points
from nss_ros.geometry import Transform

POINT_FOLDER = "point_cloud"
PANORAMA_FOLDER = "panorama"
SITE_FOLDER = "sites"
POSES_NAME = "poses.jsonl"
PAIRS_NAME = "pairs.csv"
SPLIT_FOLDER = "splits"
GRAPH_FOLDER = "pose_graph"

NEW, GONE = 1, 2


@dataclass(frozen=True, slots=True)
class FragmentColumns:
    """All that a dataset keeps of a fragment's points.

    Attributes:
        points: (n, 3) float32, metres, sensor frame.
        normals: (n, 3) float32, unit, towards the sensor.
        elements: (n,) int32, index of the element under each point; None without labels.
        change: (n,) uint8, bits NEW (was not there at the stage before) and GONE (is not there
            at the next); None without labels.
    """

    points: Points
    normals: NDArray[np.float32]
    elements: NDArray[np.int32] | None = None
    change: NDArray[np.uint8] | None = None


class DatasetFolder:
    """A dataset on disk, read piece by piece.

    Args:
        path: the folder.

    Raises:
        FormatError: it is not a dataset.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest: Manifest = read_manifest(path)

    @cached_property
    def _poses(self) -> dict[FragmentId, Transform]:
        path = self.path / POSES_NAME
        if not path.exists() and not self.manifest.complete:
            return {}
        poses = read_poses(path)
        expected = self.manifest.fragment_count()
        if self.manifest.complete and len(poses) != expected:
            raise FormatError(
                f"{path} holds {len(poses)} poses, but the manifest says {expected}: complete the "
                "dataset with 'nss simulate' and the same settings."
            )
        return poses

    def fragment_ids(self, area: str | None = None) -> list[FragmentId]:
        """All fragments, or those of one area, in canonical order.

        Raises:
            FormatError: the poses cannot be read.
        """
        return [each for each in self._poses if area in (None, each.area)]

    def poses(self) -> dict[FragmentId, Transform]:
        """`T_map_fragment` of every fragment, in canonical order; one map frame per area.

        Raises:
            FormatError: the poses cannot be read.
        """
        return dict(self._poses)

    def areas(self) -> list[str]:
        """The names of the areas, in the order they were made."""
        return list(self.manifest.areas)

    def point_file(self, fragment: FragmentId) -> Path:
        """The PLY file of a fragment."""
        return point_file(self.path, fragment)

    def fragment(self, fragment: FragmentId) -> Fragment:
        """A fragment's points.

        Raises:
            InputError: the dataset has no such fragment.
            FormatError: its file is missing or damaged.
        """
        points = self.columns(fragment).points
        return Fragment(fragment, points, self.manifest.gravity_aligned)

    def columns(self, fragment: FragmentId) -> FragmentColumns:
        """A fragment's points with their normals and labels.

        Raises:
            InputError: the dataset has no such fragment.
            FormatError: its file is missing or damaged.
        """
        self._check(fragment)
        path = self.point_file(fragment)
        if not path.exists():
            raise FormatError(
                f"{path} is missing: make it again with 'nss simulate' and the same settings."
            )
        return read_fragment_columns(path)

    def panorama(self, fragment: FragmentId) -> NDArray[np.uint16] | None:
        """A fragment's depth panorama, (h, w); None if the dataset has none.

        Raises:
            InputError: the dataset has no such fragment.
            FormatError: the file is damaged.
        """
        self._check(fragment)
        path = panorama_file(self.path, fragment)
        return read_depth_image(path) if path.exists() else None

    def site(self, area: str) -> SiteRecord:
        """What stood where and when in an area.

        Raises:
            InputError: the dataset has no such area.
            FormatError: the file is missing or damaged.
        """
        if area not in self.manifest.areas:
            known = ", ".join(self.manifest.areas) or "none yet"
            raise InputError(f"{self.path} has no area '{area}': its areas are {known}.")
        return read_site(site_file(self.path, area))

    def changed(self, fragment: FragmentId, stage: int) -> NDArray[np.bool_]:
        """Which points of a fragment lie on something that is not there at another stage.

        Args:
            fragment: the fragment.
            stage: the other stage.

        Returns:
            (n,) True where it is absent.

        Raises:
            InputError: the dataset has no such fragment or no labels.
            FormatError: a file is missing or damaged.
        """
        elements = self.columns(fragment).elements
        if elements is None:
            raise InputError(f"{self.path} was made without labels: make it again with labels.")
        return np.asarray(~self.site(fragment.area).present(stage)[elements])

    def _check(self, fragment: FragmentId) -> None:
        if fragment not in self._poses:
            raise InputError(f"{self.path} has no fragment {fragment}.")


def point_file(folder: Path, fragment: FragmentId) -> Path:
    """Where a dataset folder keeps a fragment's points."""
    return folder / POINT_FOLDER / f"{fragment}.ply"


def panorama_file(folder: Path, fragment: FragmentId) -> Path:
    """Where a dataset folder keeps a fragment's depth panorama."""
    return folder / PANORAMA_FOLDER / f"{fragment}.png"


def site_file(folder: Path, area: str) -> Path:
    """Where a dataset folder keeps an area's elements."""
    return folder / SITE_FOLDER / f"{area}.json"


def write_fragment_columns(path: Path, columns: FragmentColumns) -> None:
    """Write a fragment's PLY file.

    Raises:
        FormatError: the file cannot be written.
    """
    table = dict(zip("xyz", columns.points.T, strict=True))
    table |= dict(zip(("nx", "ny", "nz"), columns.normals.T, strict=True))
    labels = {"element": columns.elements, "change": columns.change}
    write_ply(path, table | {name: label for name, label in labels.items() if label is not None})


def read_fragment_columns(path: Path) -> FragmentColumns:
    """Read a fragment's PLY file.

    Raises:
        FormatError: the file cannot be read, or lacks normals.
    """
    table = read_columns(path)
    missing = [name for name in ("nx", "ny", "nz") if name not in table]
    if missing:
        raise FormatError(f"The vertices of {path} have no property '{missing[0]}'.")
    elements, change = table.get("element"), table.get("change")
    return FragmentColumns(
        points=_vectors([table[name] for name in "xyz"]),
        normals=_vectors([table[name] for name in ("nx", "ny", "nz")]),
        elements=None if elements is None else elements.astype(np.int32),
        change=None if change is None else change.astype(np.uint8),
    )


def write_panorama(folder: Path, fragment: FragmentId, image: NDArray[np.uint16]) -> None:
    """Write a fragment's depth panorama.

    Raises:
        FormatError: the file cannot be written.
    """
    write_depth_image(panorama_file(folder, fragment), image)


def _vectors(columns: Sequence[NDArray[np.generic]]) -> NDArray[np.float32]:
    return np.column_stack(columns).astype(np.float32)
