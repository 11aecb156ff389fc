"""`nss propose`: pairs for a bag whose pairs nobody chose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import TaskID

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.cli.pairs import WorkersOption
from nss_ros.cli.progress import progress_bar
from nss_ros.config import ProposalConfig, load_config


def propose(
    bag: Annotated[Path, typer.Argument(help="Bag with fragments, or a log.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the new bag.")],
    within: Annotated[
        int, typer.Option(min=0, help="Pairs of each fragment with others of its stage.")
    ] = ProposalConfig().within,
    across: Annotated[
        int, typer.Option(min=0, help="Pairs of each fragment with others of other stages.")
    ] = ProposalConfig().across,
    anew: Annotated[
        bool, typer.Option("--anew", help="Forget the pairs that the bag asks for.")
    ] = False,
    workers: WorkersOption = 0,
    config: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Copy a bag and ask for the pairs that look most like overlapping.

    All pairs of an area are looked at, coarsely, and some are proposed for
    each fragment that is levelled. Ground truth is copied and not looked at.

    For fragments whose pairs nobody chose, such as those of the challenge's
    test graphs; 'nss import' asks for all pairs of these: give --anew.
    """
    from nss_ros.batch.proposing import propose as propose_pairs

    registration = load_config(config, list(set_)).registration
    with progress_bar(quiet=json) as progress:
        tasks: dict[str, TaskID] = {}

        def report(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what, total=total)
            progress.update(tasks[what], completed=done)

        made = propose_pairs(bag, output, within, across, registration, anew, workers, report)
    if json:
        print_json(
            {
                "bag": str(output),
                "pairs": len(made.pairs),
                "given": made.given,
                "possible": made.possible,
                "unfit": [str(each) for each in made.unfit],
            }
        )
        return
    console = Console()
    if made.unfit:
        console.print(
            f"{len(made.unfit)} fragments are not levelled or have too few points, "
            f"{made.unfit[0]} for example: no pairs are proposed for them.",
            style="yellow",
            soft_wrap=True,
        )
    console.print(
        f"{output}: {len(made.pairs)} of {made.possible} possible pairs, {made.given} of them "
        "asked for before.",
        soft_wrap=True,
        highlight=False,
    )
