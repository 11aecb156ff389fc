"""From sites to a dataset folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import SimulationConfig
from nss_ros.dataset.folder import GONE, NEW, DatasetFolder, FragmentColumns
from nss_ros.dataset.manifest import Manifest, current_versions
from nss_ros.dataset.site_record import site_record
from nss_ros.dataset.writer import DatasetWriter
from nss_ros.fragment import FragmentId
from nss_ros.simulation.simulator import simulate_site
from nss_ros.simulation.site import Site, changed_since


def generate(
    path: Path,
    areas: Iterable[tuple[str, Callable[[], Site]]],
    config: SimulationConfig,
    sites: Mapping[str, Any] | None = None,
    labels: bool = True,
    workers: int = 0,
    report: Callable[[FragmentId], None] | None = None,
    left_out: Callable[[FragmentId], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> DatasetFolder:
    """Scan sites into a dataset folder; a folder that was cut short is completed.

    The same settings give the same bytes, however many workers there are and however often the
    run was interrupted. Areas that are complete are not even built again.

    Args:
        path: folder to create or to complete.
        areas: name of each area, and what builds it; built one at a time.
        config: of the scans, with the seed.
        sites: what the areas are built from (the site file), for the manifest.
        labels: write `element` and `change` of every point.
        workers: processes; 0: one per core.
        report: called after each fragment that was made.
        left_out: called for each spot that sees nothing and so gives no fragment.
        warn: called with a sentence for each stage in which floor is cut off and gets no spot.

    Raises:
        InputError: the folder holds something else or a dataset of other settings, or a stage has
            no floor to stand on.
        FormatError: a file cannot be read or written.
    """
    settings = config.model_dump(mode="json")
    manifest = Manifest(
        seed=config.seed,
        simulation=settings,
        sites=dict(sites or {}),
        labels=labels,
        versions=current_versions(),
    )
    writer = DatasetWriter(path, manifest, panoramas=config.panorama)
    for name, build in areas:
        if not writer.area_complete(name):
            _generate_area(writer, build(), config, labels, workers, report, left_out, warn)
    writer.finish()
    return DatasetFolder(path)


def change_labels(site: Site, elements: NDArray[np.int32], stage: int) -> NDArray[np.uint8]:
    """The `change` of points: NEW if absent at the stage before, GONE if absent at the next.

    Args:
        site: whose elements they are.
        elements: (n,) index of the element under each point.
        stage: at which they were scanned.
    """
    change = np.zeros(len(elements), dtype=np.uint8)
    if stage > 1:
        change[changed_since(site, elements, stage - 1)] |= NEW
    if stage < site.stages:
        change[changed_since(site, elements, stage + 1)] |= GONE
    return change


def _generate_area(
    writer: DatasetWriter,
    site: Site,
    config: SimulationConfig,
    labels: bool,
    workers: int,
    report: Callable[[FragmentId], None] | None,
    left_out: Callable[[FragmentId], None] | None,
    warn: Callable[[str], None] | None,
) -> None:
    writer.begin_area(site_record(site), site.source)
    done = writer.done(site.area)
    scans = simulate_site(site, config, config.seed, workers, done, report=left_out, warn=warn)
    for scan in scans:
        fragment = scan.fragment
        columns = FragmentColumns(fragment.points, scan.normals)
        if labels:
            change = change_labels(site, scan.elements, fragment.id.stage)
            columns = FragmentColumns(fragment.points, scan.normals, scan.elements, change)
        writer.append(fragment.id, scan.T_map_fragment, columns, scan.panorama)
        if report:
            report(fragment.id)
    writer.finish_area(site.area)
