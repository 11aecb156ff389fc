"""`nss refine`: ground truth between stages, refined where the global alignment is not exact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import DatasetArgument, EngineOption, WorkersOption
from nss_ros.cli.progress import progress_bar
from nss_ros.config import RefinementConfig, load_config
from nss_ros.dataset.annotate import pair_sets
from nss_ros.dataset.drift import drifted_poses
from nss_ros.dataset.figures import write_figure
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.refinement import (
    REFINED_NAME,
    STUDY_RADII,
    RadiusStatistics,
    RefinedPair,
    radius_study,
    refine_pairs,
    write_refined,
)
from nss_ros.dataset.refinement_figure import radius_figure
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform
from nss_ros.parallel import Engine
from nss_ros.table import Column, Table


def refine(
    dataset: DatasetArgument,
    study: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead compare radii of 2 to 18 m, and write the plot (png, svg, pdf).",
        ),
    ] = None,
    drift: Annotated[
        float,
        typer.Option(min=0, help="With --study: displace the poses by this first, metres (sigma)."),
    ] = 0.0,
    drift_length: Annotated[
        float,
        typer.Option(
            min=1, help="With --drift: distance over which the displacement changes, metres."
        ),
    ] = 25.0,
    count: Annotated[
        int, typer.Option("--pairs", min=1, help="With --study: number of pairs, drawn at random.")
    ] = 30,
    seed: Annotated[int, typer.Option(min=0, help="Seed of what is drawn.")] = 0,
    engine: EngineOption = Engine.LOCAL,
    workers: WorkersOption = 0,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Refine the relative transforms of different-stage pairs by what stands around both spots.

    Upright cylinders around the spots are cut from the scans of both stages and aligned by ICP.
    The results are written to refined_pairs.jsonl, from where 'nss graphs' and 'nss export' take
    the transforms of these pairs; poses and pairs stay as they are. Remove the file to go back.
    """
    settings = load_config(config, set_).dataset
    folder = DatasetFolder(dataset)
    pairs = _pairs(folder, settings.pairs.min_overlap)
    if study is not None:
        drifted = drifted_poses(folder.poses(), seed, drift, length=drift_length) if drift else None
        rows = _study(
            folder, pairs, settings.refinement, drifted, count, seed, workers, engine, json
        )
        write_figure(study, radius_figure(rows, settings.refinement.radius))
        _print_study(rows, study, json)
        return
    with progress_bar(quiet=json) as progress:
        task = progress.add_task("pairs", total=len(pairs))
        refined = refine_pairs(
            folder,
            pairs,
            settings.refinement,
            workers=workers,
            engine=engine,
            report=lambda _: progress.advance(task),
        )
    write_refined(folder.path, refined)
    _print_refined(refined, folder.path / REFINED_NAME, json)


def _pairs(dataset: DatasetFolder, min_overlap: float) -> list[FragmentPair]:
    (table,) = pair_sets(dataset, None).values()
    pairs = table.take((table.overlap_ratio >= min_overlap) & ~table.same_stage).pairs
    if not pairs:
        raise InputError(f"{dataset.path} has no pair of different stages that overlaps enough.")
    return pairs


def _study(
    dataset: DatasetFolder,
    pairs: list[FragmentPair],
    config: RefinementConfig,
    drifted: Mapping[FragmentId, Transform] | None,
    count: int,
    seed: int,
    workers: int,
    engine: Engine,
    quiet: bool,
) -> list[RadiusStatistics]:
    chosen = np.random.default_rng(seed).permutation(len(pairs))[:count]
    drawn = [pairs[i] for i in sorted(chosen.tolist())]
    with progress_bar(quiet) as progress:
        task = progress.add_task("pairs", total=len(drawn))
        return radius_study(
            dataset,
            drawn,
            config,
            STUDY_RADII,
            poses=drifted,
            truth=dataset.poses() if drifted else None,
            workers=workers,
            engine=engine,
            report=lambda _: progress.advance(task),
        )


def _print_study(rows: list[RadiusStatistics], path: Path, json: bool) -> None:
    if json:
        print_json({"plot": str(path), "radii": [asdict(row) for row in rows]})
        return
    columns = (
        Column("radius", "m", "g"),
        Column("accepted", "%", ".0f"),
        *(Column(name, "mm", ".1f") for name in ("residual", "spread", "change", "error")),
    )
    cells = tuple(
        (
            row.radius,
            100 * row.accepted,
            *(1000 * value for value in (row.rmse, row.spread, row.step, row.error)),
        )
        for row in rows
    )
    console = Console()
    console.print(
        Table(f"Radius of the cylinders, {rows[0].pairs} pairs", columns, cells).to_rich()
    )
    console.print(f"Plot: {path}", soft_wrap=True, highlight=False)


def _print_refined(refined: dict[FragmentPair, RefinedPair], path: Path, json: bool) -> None:
    accepted = [each for each in refined.values() if each.accepted]
    summary: dict[str, Any] = {
        "file": str(path),
        "pairs": len(refined),
        "refined": len(accepted),
        "median_translation": median([a.translation for a in accepted]) if accepted else None,
    }
    if json:
        print_json(summary)
        return
    moved = f", by {1000 * summary['median_translation']:.1f} mm in the median" if accepted else ""
    Console().print(
        f"Refined {len(accepted)} of {len(refined)} pairs{moved}; the global alignment of the "
        f"others stands, with the reason.\nPairs: {path}",
        soft_wrap=True,
        highlight=False,
    )
