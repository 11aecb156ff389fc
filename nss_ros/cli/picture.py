"""`nss picture`: what sites look like, stage by stage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.cli.progress import progress_bar
from nss_ros.cli.simulate import StoreysOption
from nss_ros.simulation.picture import interiors_picture, stages_picture, write_png
from nss_ros.simulation.site_file import areas, site_file_of
from nss_ros.simulation.view import widest_view


def picture(
    sites: Annotated[
        list[str], typer.Argument(metavar="SITE...", help="As of 'nss simulate', e.g. six_areas.")
    ],
    storeys: StoreysOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the PNG files.")
    ] = Path("pictures"),
    seed: Annotated[int, typer.Option(min=0, help="Seed, as of 'nss simulate'.")] = 0,
    width: Annotated[
        int, typer.Option(min=200, max=10_000, help="Width of a picture, pixels.")
    ] = 1600,
) -> None:
    """Draw every area of a site at every stage: cut open from above, and from inside.

    What is new since the stage before is orange in the view from above.
    """
    site_file, folder = site_file_of(sites, storeys=storeys)
    output.mkdir(parents=True, exist_ok=True)
    console = Console()
    built = areas(site_file, folder, seed)
    with progress_bar() as progress:
        for name, build in progress.track(built, description="areas"):
            site = build()
            for sentence in (*site.source.get("skipped", ()), *site.source.get("notes", ())):
                console.print(sentence, style="yellow", soft_wrap=True, highlight=False)
            view_in = widest_view(site)
            for view, image in (
                ("stages", stages_picture(site, width)),
                ("interiors", interiors_picture(site, view_in.eye, view_in.heading, width)),
            ):
                path = output / f"area_{name}_{view}.png"
                write_png(path, image, colours=256)
                console.print(f"Wrote {path}", soft_wrap=True, highlight=False)
