"""Making a dataset folder fragment by fragment, so that a killed run can be continued."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.dataset.folder import (
    PANORAMA_FOLDER,
    POINT_FOLDER,
    POSES_NAME,
    SITE_FOLDER,
    FragmentColumns,
    panorama_file,
    point_file,
    site_file,
    write_fragment_columns,
    write_panorama,
)
from nss_ros.dataset.manifest import (
    MANIFEST_NAME,
    AreaRecord,
    Manifest,
    StageRecord,
    read_manifest,
    write_manifest,
)
from nss_ros.dataset.pose_file import append_pose, read_poses, write_poses
from nss_ros.dataset.site_record import SiteRecord, write_site
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform


class DatasetWriter:
    """A dataset being made: a new folder, or one whose making was cut short.

    A fragment counts once its pose is on record, and its pose is written after its points. The
    finished folder is the same, byte for byte, however often the run was interrupted. A folder in
    which no area was begun is as good as new: other settings are welcome there.

    Args:
        path: folder; created if it is not there.
        manifest: how the dataset is made, without areas.
        panoramas: every fragment has a panorama.

    Raises:
        InputError: the folder holds something else, or a dataset that is made differently.
        FormatError: the folder cannot be written, or its manifest or poses cannot be read.
    """

    def __init__(self, path: Path, manifest: Manifest, panoramas: bool = False) -> None:
        self.path = path
        self._panoramas = panoramas
        self._poses: dict[FragmentId, Transform] = {}
        if (path / MANIFEST_NAME).exists():
            self._manifest = read_manifest(path)
            if self._manifest.areas or self._manifest.complete:
                _check_same(path, self._manifest, manifest)
            else:  # no site could be built: nothing is lost where it is begun in another way
                self._manifest = manifest
        elif path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(
                f"{path} exists and is not a dataset: choose another name or remove it."
            )
        else:
            self._manifest = manifest
        self._make_folders()
        if (path / POSES_NAME).exists():
            self._poses = {
                id_: pose for id_, pose in read_poses(path / POSES_NAME).items() if self._has(id_)
            }
        # Also drops a line that was cut short, and poses whose files are gone.
        write_poses(path / POSES_NAME, self._poses)

    @property
    def manifest(self) -> Manifest:
        """As it stands."""
        return self._manifest

    def done(self, area: str) -> set[FragmentId]:
        """The fragments of an area that are there with their pose."""
        return {fragment for fragment in self._poses if fragment.area == area}

    def area_complete(self, area: str) -> bool:
        """Whether all fragments of an area are there."""
        record = self._manifest.areas.get(area)
        if record is None or not record.complete:
            return False
        return len(self.done(area)) == sum(stage.fragments or 0 for stage in record.stages)

    def begin_area(self, site: SiteRecord, source: Mapping[str, Any]) -> None:
        """Record the site of an area, before its first fragment.

        Args:
            site: its elements and stages.
            source: what it was made from, as JSON can hold it.

        Raises:
            InputError: the area was begun with another site.
            FormatError: a file cannot be written.
        """
        origin = json.loads(json.dumps(source))
        before = self._manifest.areas.get(site.area)
        if before is not None and before.source != origin:
            raise InputError(
                f"Area {site.area} of {self.path} was begun with another site: finish it with "
                "that, or give another folder."
            )
        write_site(site_file(self.path, site.area), site)
        names = site.stage_names or [""] * site.stages
        self._set_area(
            site.area, AreaRecord(stages=[StageRecord(name=name) for name in names], source=origin)
        )

    def append(
        self,
        fragment: FragmentId,
        T_map_fragment: Transform,
        columns: FragmentColumns,
        panorama: NDArray[np.uint16] | None = None,
    ) -> None:
        """Write one fragment; once this returns it survives the process.

        Args:
            fragment: its id.
            T_map_fragment: ground truth.
            columns: its points.
            panorama: (h, w) depth, if the dataset has panoramas.

        Raises:
            FormatError: a file cannot be written.
        """
        write_fragment_columns(point_file(self.path, fragment), columns)
        if panorama is not None:
            write_panorama(self.path, fragment, panorama)
        append_pose(self.path / POSES_NAME, fragment, T_map_fragment)
        self._poses[fragment] = T_map_fragment

    def finish_area(self, area: str) -> None:
        """Record that all fragments of an area are there.

        Raises:
            FormatError: a file cannot be written.
        """
        write_poses(self.path / POSES_NAME, self._poses)
        counts = [0] * len(self._manifest.areas[area].stages)
        for fragment in self.done(area):
            counts[fragment.stage - 1] += 1
        record = self._manifest.areas[area]
        stages = [
            stage.model_copy(update={"fragments": count})
            for stage, count in zip(record.stages, counts, strict=True)
        ]
        self._set_area(area, record.model_copy(update={"complete": True, "stages": stages}))

    def finish(self) -> None:
        """Record that all areas are complete.

        Raises:
            FormatError: the manifest cannot be written.
        """
        self._write(self._manifest.model_copy(update={"complete": True}))

    def _has(self, fragment: FragmentId) -> bool:
        has_points = point_file(self.path, fragment).exists()
        return has_points and (not self._panoramas or panorama_file(self.path, fragment).exists())

    def _make_folders(self) -> None:
        names = [POINT_FOLDER, SITE_FOLDER] + [PANORAMA_FOLDER] * self._panoramas
        try:
            for name in names:
                (self.path / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FormatError(f"Cannot create {self.path}: {error.strerror}.") from error
        self._write(self._manifest)

    def _set_area(self, area: str, record: AreaRecord) -> None:
        areas = {**self._manifest.areas, area: record}
        self._write(self._manifest.model_copy(update={"areas": areas, "complete": False}))

    def _write(self, manifest: Manifest) -> None:
        self._manifest = manifest
        write_manifest(self.path, manifest)


def _check_same(path: Path, there: Manifest, wanted: Manifest) -> None:
    """Raise unless what is there was begun with the settings that are wanted."""
    before, now = (each.model_dump(mode="json") for each in (there, wanted))
    for key in ("seed", "simulation", "sites", "labels", "gravity_aligned", "versions"):
        difference = _difference(key, before[key], now[key])
        if difference:
            raise InputError(
                f"{path} was begun with {difference}: finish it with that, or give another folder."
            )


def _difference(name: str, before: Any, now: Any) -> str:
    """The first setting that differs, with both values; empty if none does."""
    if before == now:
        return ""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return f"{name} = {json.dumps(before)}, not {json.dumps(now)}"
    for key in [*before, *(key for key in now if key not in before)]:
        difference = _difference(f"{name}.{key}", before.get(key), now.get(key))
        if difference:
            return difference
    return ""
