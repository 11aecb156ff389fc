"""`nss simulate`: a dataset of fragments with ground truth, scanned from models of buildings."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import WorkersOption
from nss_ros.cli.progress import progress_bar
from nss_ros.config import NssConfig, load_config
from nss_ros.dataset.annotate import add_pairs
from nss_ros.dataset.bag_export import export_bag
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.generate import generate
from nss_ros.errors import BagError
from nss_ros.fragment import FragmentId
from nss_ros.simulation.site_file import areas, built_in_sites, settings_for, site_file_of
from nss_ros.table import Align, Column, Table

StoreysOption = Annotated[
    str | None,
    typer.Option(
        metavar="PATTERN",
        help="Of IFC files, make an area of each storey with walls or columns whose name matches; "
        "'*' for all. Without it: one area, the storey of most elements.",
    ),
]


def simulate(
    sites: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SITE]...",
            help=f"One of {', '.join(built_in_sites())} (default: one_floor); a site file "
            "(YAML); IFC files of one building; or one mesh per stage.",
        ),
    ] = None,
    storeys: StoreysOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Dataset folder; one cut short is completed.")
    ] = Path("dataset"),
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of everything random.")] = None,
    spots_per_stage: Annotated[
        int | None,
        typer.Option(min=0, help="Most tripod spots per stage; 0: until all is seen."),
    ] = None,
    panoramas: Annotated[
        bool, typer.Option("--panoramas", help="Write depth panoramas, too.")
    ] = False,
    labels: Annotated[
        bool, typer.Option(help="Write the element and its change under every point.")
    ] = True,
    bag: Annotated[
        Path | None,
        typer.Option(
            metavar="BAG", help="Also measure the pairs ('nss pairs') and write a bag to map."
        ),
    ] = None,
    workers: WorkersOption = 0,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Scan building models, stage by stage, into a dataset with ground truth.

    The same seed, sites and settings give the same bytes. 'nss pairs', 'nss graphs' and
    'nss stats' take the dataset from there.
    """
    overrides = list(set_)
    overrides += [f"simulation.seed={seed}"] if seed is not None else []
    overrides += ["simulation.panorama=true"] if panoramas else []
    if spots_per_stage is not None:
        overrides.append(f"simulation.viewpoints.spots_per_stage={spots_per_stage}")
    settings = load_config(config, overrides)
    if bag is not None and bag.exists():
        raise BagError(f"{bag} exists already: choose another name or remove it.")
    begin = time.monotonic()
    warnings: list[str] = []
    dataset = _generate(
        sites or ["one_floor"], storeys, output, settings, labels, workers, warnings, quiet=json
    )
    summary = _summary(dataset) | {"warnings": warnings}
    if bag is not None:
        summary["bag"] = _bag(bag, dataset, settings, workers, quiet=json)
    summary["seconds"] = time.monotonic() - begin
    if json:
        print_json(summary)
    else:
        _print(summary)


def _generate(
    sites: list[str],
    storeys: str | None,
    output: Path,
    settings: NssConfig,
    labels: bool,
    workers: int,
    warnings: list[str],
    quiet: bool,
) -> DatasetFolder:
    with progress_bar(quiet) as progress:
        reading = progress.add_task("models", total=None, visible=False)
        scanning = progress.add_task("fragments", total=None)

        def read(name: str, done: int, total: int) -> None:
            progress.update(reading, description=name, completed=done, total=total, visible=True)

        site_file, folder = site_file_of(sites, storeys=storeys, report=read)
        simulation = settings_for(site_file, settings.simulation)

        def scanned(fragment: FragmentId) -> None:
            progress.update(scanning, description=f"fragments of area {fragment.area}", advance=1)

        def left_out(spot: FragmentId) -> None:
            progress.console.print(f"{spot} sees nothing and is left out.", style="yellow")

        return generate(
            output,
            areas(site_file, folder, simulation.seed, read),
            simulation,
            site_file.model_dump(mode="json", exclude_none=True),
            labels,
            workers,
            scanned,
            left_out,
            warnings.append,
        )


def _bag(
    bag: Path, dataset: DatasetFolder, settings: NssConfig, workers: int, quiet: bool
) -> dict[str, Any]:
    pairs, seed = settings.dataset.pairs, settings.simulation.seed
    with progress_bar(quiet) as progress:
        tasks = {name: progress.add_task(name, total=None) for name in ("fragments", "pairs")}

        def report(name: str, done: int, total: int) -> None:
            progress.update(tasks[name], completed=done, total=total)

        made = add_pairs(dataset, pairs, settings.dataset.splits, seed, workers, report=report)
        chosen = export_bag(bag, dataset, made.pairs, pairs.min_overlap)
    same = int(chosen.same_stage.sum())
    return {
        "path": str(bag),
        "bytes": sum(file.stat().st_size for file in bag.iterdir()),
        "same_stage_pairs": same,
        "different_stage_pairs": len(chosen) - same,
    }


def _summary(dataset: DatasetFolder) -> dict[str, Any]:
    return {
        "dataset": str(dataset.path),
        "fragments": dataset.manifest.fragment_count(),
        "areas": {
            name: {
                "stages": [
                    {"name": stage.name, "fragments": stage.fragments} for stage in area.stages
                ],
                "skipped": area.source.get("skipped", []),
                "notes": area.source.get("notes", []),
            }
            for name, area in dataset.manifest.areas.items()
        },
    }


def _print(summary: dict[str, Any]) -> None:
    console = Console()
    rows = tuple(
        (name, number, stage["name"], stage["fragments"])
        for name, area in summary["areas"].items()
        for number, stage in enumerate(area["stages"], start=1)
    )
    columns = (
        Column("area", align=Align.LEFT),
        Column("stage"),
        Column("name", align=Align.LEFT),
        Column("fragments"),
    )
    console.print(Table("Fragments", columns, rows).to_rich())
    sentences = [
        text for area in summary["areas"].values() for text in (*area["skipped"], *area["notes"])
    ]
    for sentence in [*sentences, *summary["warnings"]]:
        console.print(sentence, style="yellow", soft_wrap=True, highlight=False)
    if bag := summary.get("bag"):
        console.print(
            f"Bag: {bag['path']} ({bag['bytes'] / 1e6:.1f} MB, {bag['same_stage_pairs']} "
            f"same-stage and {bag['different_stage_pairs']} different-stage pairs)",
            soft_wrap=True,
            highlight=False,
        )
    console.print(
        f"{summary['fragments']} fragments in {summary['seconds']:.0f} s. "
        f"Dataset: {summary['dataset']}",
        soft_wrap=True,
        highlight=False,
    )
