"""`nss import`: a challenge folder becomes a bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track

from nss_ros.bag import write_bag
from nss_ros.cli.output import print_json
from nss_ros.dataset.challenge_folder import (
    ChallengeFolder,
    PairChoice,
    read_folder,
    read_fragment,
)
from nss_ros.dataset.manifest import MANIFEST_NAME, read_manifest
from nss_ros.fragment import Fragment
from nss_ros.multiway.pose_graph import NodeStatus


def import_folder(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="NSS-challenge folder: point_cloud/*.ply, pose_graph/**/*.json."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Bag folder to create.")],
    graph: Annotated[
        str | None,
        typer.Option(
            metavar="GLOB",
            help="Take only the graphs whose name, or whose file's name or path in DIR, matches.",
        ),
    ] = None,
    pairs: Annotated[
        PairChoice,
        typer.Option(
            help="Pairs to register: the graphs' edges, all pairs of each graph's nodes, or "
            "(auto) the edges where a graph has any and else all pairs."
        ),
    ] = PairChoice.AUTO,
    gravity_aligned: Annotated[
        bool, typer.Option("--gravity-aligned", help="State that z points up in every fragment.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Turn a folder of the NSS challenge into a bag.

    Reads the field names of 2024 and 2025. Several graphs share their fragments and pairs in one
    bag. Ground truth goes to the topic ground_truth, which only the scorer reads.
    """
    challenge = read_folder(folder, graph, pairs)
    if (folder / MANIFEST_NAME).exists():  # one of our own datasets, which says it itself
        gravity_aligned = gravity_aligned or read_manifest(folder).gravity_aligned
    fragments = _Fragments(challenge, gravity_aligned, quiet=json)
    metadata = {"source": f"NSS challenge folder {folder.resolve().name}"}
    write_bag(
        output,
        fragments,
        challenge.pairs,
        challenge.ground_truth,
        metadata | challenge.metadata(),
    )
    summary = _summary(challenge, fragments, output)
    if json:
        print_json(summary)
        return
    console = Console()
    console.print(
        "Imported {graphs} graph(s): {fragments} fragments with {points} points, {pairs} pairs to "
        "register; ground truth: {placed} poses, {edges} edges, {outliers} outliers.".format(
            **summary
        ),
        soft_wrap=True,
        highlight=False,
    )
    if fragments.dropped:
        console.print(f"Left out {fragments.dropped} points with non-finite coordinates.")
    console.print(f"Bag: {output}", soft_wrap=True, highlight=False)


class _Fragments:
    """The fragments of a folder, read one by one; counts what it has read."""

    def __init__(self, challenge: ChallengeFolder, gravity_aligned: bool, quiet: bool) -> None:
        self._files = challenge.point_files
        self._gravity_aligned = gravity_aligned
        self._quiet = quiet
        self.points = 0
        self.dropped = 0

    def __iter__(self) -> Iterator[Fragment]:
        items = track(
            self._files.items(),
            "fragments",
            console=Console(stderr=True),
            disable=self._quiet,
        )
        for fragment_id, file in items:
            fragment, dropped = read_fragment(fragment_id, file, self._gravity_aligned)
            self.points += len(fragment.points)
            self.dropped += dropped
            yield fragment


def _summary(
    challenge: ChallengeFolder, fragments: _Fragments, output: Path
) -> dict[str, int | str]:
    statuses = [node.status for graph in challenge.ground_truth for node in graph.nodes]
    return {
        "bag": str(output),
        "graphs": len(challenge.graphs),
        "fragments": len(challenge.point_files),
        "points": fragments.points,
        "dropped_points": fragments.dropped,
        "pairs": len(challenge.pairs),
        "placed": statuses.count(NodeStatus.PLACED),
        "edges": sum(len(graph.edges) for graph in challenge.ground_truth),
        "outliers": statuses.count(NodeStatus.OUTLIER),
    }
