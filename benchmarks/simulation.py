"""How fast sites are scanned, against the bare ray casting of exactly the same rays.

    ./nss python benchmarks/simulation.py [--width M] [--depth M] [--stages N] [--workers N]

A procedural floor is built, the spots of all stages are chosen, and all fragments are simulated
and written as PLY files. In turns with that, the same rays are cast again by as many processes,
and nothing but the casting is timed. The ratio is the time of the whole, times the processes,
over that.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from nss_ros.config import SimulationConfig, SiteConfig
from nss_ros.dataset.folder import FragmentColumns, write_fragment_columns
from nss_ros.parallel import run
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.rig import draw_pose, scan
from nss_ros.simulation.scene import Hits, Scene
from nss_ros.simulation.simulator import Spot, choose_spots, simulate_site, spot_stream
from nss_ros.simulation.site import Site, StageMesh

if TYPE_CHECKING:
    from numpy.typing import NDArray

CONFIG = SimulationConfig()


class RecordingScene(Scene):
    """A scene that keeps the rays it casts."""

    def __init__(self, mesh: StageMesh) -> None:
        super().__init__(mesh.mesh, mesh.materials)
        self._rays: list[NDArray[np.float32]] = []

    def cast(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """As `Scene.cast`."""
        starts = np.broadcast_to(origins - self._offset, directions.shape)
        self._rays.append(np.hstack((starts, directions)).astype(np.float32))
        return super().cast(origins, directions)

    def cast_again(self) -> float:
        """Seconds of casting all rays that were kept in one go; they are forgotten."""
        rays = self._tensor(np.concatenate(self._rays))
        self._rays.clear()
        begin = time.perf_counter()
        self._scene.cast_rays(rays, nthreads=1)
        return time.perf_counter() - begin


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=float, default=40.0, help="of the floor, metres")
    parser.add_argument("--depth", type=float, default=25.0, help="of the floor, metres")
    parser.add_argument("--stages", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    measure(
        SiteConfig(width=arguments.width, depth=arguments.depth, stages=arguments.stages),
        arguments.workers,
    )


def measure(config: SiteConfig, workers: int) -> None:
    """Build a floor, scan it with so many processes, and print a table."""
    begin = time.perf_counter()
    site = build_floor("1", config, CONFIG.seed)
    seconds = {"site": time.perf_counter() - begin}
    list(run(abs, range(workers), workers))  # starts the processes
    begin = time.perf_counter()
    spots = choose_spots(site, CONFIG, CONFIG.seed, workers)
    seconds["viewpoints of all stages"] = time.perf_counter() - begin
    points, whole, bare = 0, 0.0, 0.0
    for part in _parts(spots):  # in turns: the machine may do other work meanwhile
        begin = time.perf_counter()
        points += _write_all(site, part, workers)
        whole += time.perf_counter() - begin
        mesh = site.stage_mesh(part[0].id.stage)
        bare += sum(run(bare_seconds, [(mesh, part[k::workers]) for k in range(workers)], workers))
    seconds["fragments, with their files"] = whole
    seconds["bare ray casting, all processes"] = bare
    table = Table(
        "", "seconds", title=f"{config.width:g} x {config.depth:g} m, {workers} processes"
    )
    table.columns[1].justify = "right"
    for name, value in seconds.items():
        table.add_row(name, f"{value:.2f}")
    table.add_section()
    triangles = [len(site.stage_mesh(s).elements) for s in range(1, site.stages + 1)]
    table.add_row("triangles per stage", ", ".join(f"{count:,}" for count in triangles))
    per_stage = [sum(spot.id.stage == s for spot in spots) for s in range(1, site.stages + 1)]
    table.add_row("fragments per stage", ", ".join(map(str, per_stage)))
    table.add_row("points per fragment", f"{points / len(spots):,.0f}")
    table.add_row("fragments per second", f"{len(spots) / whole:.1f}")
    table.add_row("whole / bare ray casting", f"{whole * workers / bare:.2f}")
    Console().print(table)


def _parts(spots: list[Spot]) -> list[list[Spot]]:
    """The spots in runs of one stage and at most 30."""
    parts: list[list[Spot]] = []
    for spot in spots:
        if not parts or len(parts[-1]) == 30 or parts[-1][0].id.stage != spot.id.stage:
            parts.append([])
        parts[-1].append(spot)
    return parts


def _write_all(site: Site, spots: list[Spot], workers: int) -> int:
    """Simulate all fragments and write their files; the number of their points."""
    points = 0
    with tempfile.TemporaryDirectory() as folder:
        for taken in simulate_site(site, CONFIG, CONFIG.seed, workers, spots=spots):
            columns = FragmentColumns(taken.fragment.points, taken.normals)
            write_fragment_columns(Path(folder) / f"{taken.fragment.id}.ply", columns)
            points += len(taken.fragment.points)
    return points


def bare_seconds(call: tuple[StageMesh, list[Spot]]) -> float:
    """Seconds of casting all rays of some spots, and of nothing else."""
    mesh, spots = call
    scene = RecordingScene(mesh)
    seconds = 0.0
    for spot in spots:
        rng = spot_stream(CONFIG.seed, spot.id)
        scan(scene, draw_pose(spot.place, CONFIG.rig, rng), CONFIG.rig, rng)
        seconds += scene.cast_again()
    return seconds


if __name__ == "__main__":
    main()
