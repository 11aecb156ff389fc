"""From a site to scans: viewpoints of every stage, and what the scanner sees from each."""

from __future__ import annotations

import itertools
import os
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import SimulationConfig
from nss_ros.errors import InputError
from nss_ros.fragment import (
    Fragment,
    FragmentId,
    Points,
    occupied_voxels,
    voxel_means,
)
from nss_ros.geometry import Transform
from nss_ros.parallel import run
from nss_ros.simulation.mesh import Mesh
from nss_ros.simulation.occupancy import door_triangles, occupancy_map
from nss_ros.simulation.panorama import FULL_SCALE, panorama
from nss_ros.simulation.rig import Returns, draw_pose, scan
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Rectangle, Site, StageMesh
from nss_ros.simulation.viewpoints import choose_viewpoints, unreached_floor

_VIEWPOINT_STREAM, _SCAN_STREAM = 1, 2


@dataclass(frozen=True, slots=True)
class Spot:
    """Where a fragment is taken.

    Attributes:
        id: of the fragment.
        place: (3,) x, y of the tripod and z of the floor under it, metres, map frame.
    """

    id: FragmentId
    place: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scan:
    """A fragment, where it was taken, and what its points lie on.

    Attributes:
        fragment: voxelised points, sensor frame.
        T_map_fragment: pose of the sensor.
        normals: (n, 3) float32 unit normals of the surfaces, towards the sensor, sensor frame.
        elements: (n,) int32 index of the site's element under each point.
        panorama: (h, w) uint16 depth panorama as `nss_ros.simulation.panorama` defines it, if
            asked for.
    """

    fragment: Fragment
    T_map_fragment: Transform
    normals: NDArray[np.float32]
    elements: NDArray[np.int32]
    panorama: NDArray[np.uint16] | None = None


@dataclass(frozen=True, slots=True)
class _Stage:
    """The mesh of a stage as it goes to other processes; `key` tells it from all others there."""

    key: tuple[int, int, int]
    mesh: StageMesh


def simulate_site(
    site: Site,
    config: SimulationConfig,
    seed: int,
    workers: int = 0,
    skip: Collection[FragmentId] = (),
    spots: Sequence[Spot] | None = None,
    report: Callable[[FragmentId], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> Iterator[Scan]:
    """All fragments of a site, in canonical order.

    Every spot draws from a stream of its own, so the same seed gives the same bytes whatever
    the number of workers and whatever is skipped.

    Args:
        site: to be scanned.
        config: viewpoints, rig, voxel size, panorama.
        seed: of everything random.
        workers: processes; 0: one per core.
        skip: fragments that are there already.
        spots: what `choose_spots` gave for the same arguments, if it was called already.
        report: called with every fragment that is left out because its spot sees nothing.
        warn: as of `choose_spots`.

    Raises:
        InputError: a stage has no free floor to stand on.
    """
    chosen = choose_spots(site, config, seed, workers, warn) if spots is None else spots
    done = set(skip)
    wanted = [spot for spot in chosen if spot.id not in done]
    calls = (
        (stage, spot, config, seed)
        for stage, spot in zip(_stages(site, [s.id.stage for s in wanted]), wanted, strict=True)
    )
    for spot, taken in zip(wanted, run(_scan_spot, calls, workers), strict=True):
        if taken is not None:
            yield taken
        elif report is not None:
            report(spot.id)


def choose_spots(
    site: Site,
    config: SimulationConfig,
    seed: int,
    workers: int = 0,
    warn: Callable[[str], None] | None = None,
) -> list[Spot]:
    """The spots of all stages, in canonical order; each stage chooses its own.

    Where the spots of a stage are limited in number, all stages begin near the first spot of the
    first: a part of the building is scanned again and again, not another one each time.

    Args:
        site: to be scanned.
        config: viewpoints and range of the rig.
        seed: of the choice.
        workers: processes; 0: one per core.
        warn: called with a sentence for each stage in which free floor is cut off from the rest
            and gets no spot.

    Raises:
        InputError: a stage has no free floor to stand on.
    """
    numbers = range(1, site.stages + 1)
    chosen: list[_Places] = []
    if config.viewpoints.spots_per_stage:
        chosen += run(_choose_places, _place_calls(site, numbers[:1], config, seed), workers)
    start = tuple(chosen[0][0][0, :2].tolist()) if chosen else None
    calls = _place_calls(site, numbers[len(chosen) :], config, seed, start)
    chosen += run(_choose_places, calls, workers)
    spots = []
    for stage, (places, left_out) in zip(numbers, chosen, strict=True):
        if left_out and warn is not None:
            warn(_cut_off(site.area, stage, left_out))
        spots += [
            Spot(FragmentId(site.area, stage, spot), place)
            for spot, place in enumerate(places, start=1)
        ]
    return spots


def spot_stream(seed: int, fragment: FragmentId) -> np.random.Generator:
    """The random numbers of one spot: first of its pose, then of its noise."""
    return _stream(seed, fragment.area, fragment.stage, fragment.spot, _SCAN_STREAM)


def _stages(site: Site, numbers: Iterable[int]) -> Iterator[_Stage]:
    """The stages of these numbers, which may repeat; the last one is kept."""
    call = next(_CALLS)
    latest: _Stage | None = None
    for number in numbers:
        key = (os.getpid(), call, number)
        if latest is None or latest.key != key:
            latest = _Stage(key, site.stage_mesh(number))
        yield latest


_Start = tuple[float, float] | None
_PlaceCall = tuple[_Stage, NDArray[np.bool_], str, Rectangle, float, SimulationConfig, int, _Start]
_Places = tuple[NDArray[np.float64], list[float]]


def _place_calls(
    site: Site,
    numbers: Iterable[int],
    config: SimulationConfig,
    seed: int,
    start: _Start = None,
) -> Iterator[_PlaceCall]:
    """What `_choose_places` needs for some stages."""
    return (
        (stage, door_triangles(site, stage.mesh), site.area, site.extent, site.floor_height,
         config, seed, start)
        for stage in _stages(site, numbers)
    )  # fmt: skip


def _cut_off(area: str, stage: int, sizes: Sequence[float]) -> str:
    number = "a region" if len(sizes) == 1 else f"{len(sizes)} regions"
    return (
        f"Area {area}, stage {stage}: {sum(sizes):.0f} m2 of free floor in {number} cut off from "
        "the largest get no spot; lower simulation.viewpoints.min_region to scan them, too."
    )


def _choose_places(call: _PlaceCall) -> _Places:
    """Where the tripod is put in a stage, and the sizes of regions that it does not get to."""
    stage, of_door, area, extent, floor_height, config, seed, start = call
    number = stage.key[-1]
    occupancy = occupancy_map(_scene(stage), of_door, extent, floor_height, config.viewpoints)
    rng = _stream(seed, area, number, 0, _VIEWPOINT_STREAM)
    try:
        places = choose_viewpoints(occupancy, config.viewpoints, config.rig.max_range, rng, start)
    except InputError as error:
        raise InputError(f"Area {area}, stage {number}: {error}") from error
    return places, unreached_floor(occupancy, config.viewpoints)


def _scan_spot(call: tuple[_Stage, Spot, SimulationConfig, int]) -> Scan | None:
    """What a spot gives, None if that is nothing."""
    stage, spot, config, seed = call
    rng = spot_stream(seed, spot.id)
    T_map_fragment = draw_pose(spot.place, config.rig, rng)
    reach = max(config.rig.max_range, FULL_SCALE if config.panorama else 0)
    everything = scan(_scene(stage), T_map_fragment, config.rig, rng, reach)
    returns = everything.within(config.rig.max_range) if config.panorama else everything
    if len(returns.points) == 0:
        return None
    points, normals, triangles = _voxelized(returns, config.voxel_size)
    return Scan(
        Fragment(spot.id, points, gravity_aligned=True),
        T_map_fragment,
        normals,
        stage.mesh.elements[triangles],
        panorama(everything.points, config.panorama_height) if config.panorama else None,
    )


def _voxelized(
    returns: Returns, voxel_size: float
) -> tuple[Points, NDArray[np.float32], NDArray[np.uint32]]:
    """Mean point and normal of every voxel, and the triangle of the point nearest to the mean."""
    voxels, count = occupied_voxels(returns.points, voxel_size)
    # A row per axis throughout.
    values = np.concatenate((returns.points.T, returns.normals.T))
    points, normals = np.split(np.ascontiguousarray(voxel_means(values.T, voxels, count).T), 2)
    apart = values[:3] - points.take(voxels, axis=1)
    squared = np.square(apart, out=apart).sum(axis=0)
    least = np.full(count, np.inf, dtype=np.float32)
    np.minimum.at(least, voxels, squared)
    nearest = np.flatnonzero(squared == least.take(voxels))[::-1]
    chosen = np.empty(count, dtype=np.int64)
    chosen[voxels[nearest]] = nearest  # of several, the first stays
    lengths = np.sqrt(np.square(normals).sum(axis=0))
    # Both sides of a thin board may cancel out.
    cancelled = np.flatnonzero(lengths <= 0.1)
    normals /= np.maximum(lengths, np.float32(0.1))
    normals[:, cancelled] = values[3:].take(chosen[cancelled], axis=1)
    return (
        np.ascontiguousarray(points.T),
        np.ascontiguousarray(normals.T),
        returns.triangles.take(chosen),
    )


def _stream(seed: int, area: str, stage: int, spot: int, use: int) -> np.random.Generator:
    return np.random.default_rng((seed, zlib.crc32(area.encode()), stage, spot, use))


_CALLS = itertools.count()
_SCENES: dict[tuple[int, int, int], Scene] = {}
"""The scene that this process used last, by the key of its stage."""


def _scene(stage: _Stage) -> Scene:
    if stage.key not in _SCENES:
        _SCENES.clear()
        # Copies: joblib shares large arrays as files, and in the end waits a second for those that
        # are still in use.
        mesh = Mesh(np.array(stage.mesh.mesh.vertices), np.array(stage.mesh.mesh.triangles))
        _SCENES[stage.key] = Scene(mesh, np.array(stage.mesh.materials))
    return _SCENES[stage.key]
