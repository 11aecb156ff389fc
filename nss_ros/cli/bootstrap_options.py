"""Options of commands that resample."""

from __future__ import annotations

from typing import Annotated

import typer

ResamplingsOption = Annotated[
    int, typer.Option(min=0, help="Bootstrap resamplings; 0: no intervals.")
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the resamplings.")]
ByFragmentOption = Annotated[
    bool,
    typer.Option(
        "--by-fragment",
        help="Resample fragments, and with them pairs, instead of pairs: wider, since pairs that "
        "share a fragment are not independent.",
    ),
]
