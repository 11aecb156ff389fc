"""`nss import`: a folder of the NSS challenge or release becomes a bag, or a dataset."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track

from nss_ros.bag import write_bag
from nss_ros.cli.output import print_json
from nss_ros.cli.progress import progress_bar
from nss_ros.config import PairConfig, validated
from nss_ros.dataset.annotate import pair_sets
from nss_ros.dataset.bag_export import export_bag
from nss_ros.dataset.challenge_folder import (
    ChallengeFolder,
    PairChoice,
    read_folder,
    read_fragment,
)
from nss_ros.dataset.folder import GRAPH_FOLDER, DatasetFolder
from nss_ros.dataset.levelness import files_look_levelled, other_vertical_axis
from nss_ros.dataset.manifest import MANIFEST_NAME, read_manifest
from nss_ros.dataset.release import Release, is_release, read_release
from nss_ros.dataset.release_import import as_challenge, as_dataset
from nss_ros.dataset.splits import SETS
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import Fragment
from nss_ros.multiway.pose_graph import NodeStatus

_LOOKED = {
    True: "They look like scans of a levelled tripod, so yaw and translation are searched only; "
    "--not-gravity-aligned says that they are not.",
    False: "They do not look like scans of a levelled tripod, so any rotation is searched, which "
    "finds less; --gravity-aligned says that they are.",
}
_OTHER_VERTICAL = (
    "They do not look like scans of a levelled tripod, but would if {} were vertical: if it is, "
    "turn them so that z points up, and import them again. Else any rotation is searched, which "
    "finds less; --gravity-aligned says that they are levelled."
)


class Kind(StrEnum):
    """What a folder becomes."""

    BAG = "bag"
    DATASET = "dataset"


class SetName(StrEnum):
    """A set of a split."""

    TRAIN = "train"
    VAL = "val"
    TEST = "test"


def import_folder(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="NSS-challenge folder: point_cloud/*.ply, pose_graph/**/*.json; or NSS release: "
            "pointclouds/*.ply, annotations/<split>/<set>.json.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to create.")],
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
        bool | None,
        typer.Option(
            "--gravity-aligned/--not-gravity-aligned",
            help="Whether z points up in every fragment; else told by the floors in some of them.",
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    kind: Annotated[
        Kind, typer.Option("--as", help="Of a release: a bag to map, or a dataset folder.")
    ] = Kind.BAG,
    split: Annotated[
        str | None,
        typer.Option(help="Of a release, for a bag: which split; else the first that there is."),
    ] = None,
    sets: Annotated[
        list[SetName] | None,
        typer.Option("--subset", help="Of a release, for a bag: sets of the split; else all."),
    ] = None,
    multiway: Annotated[
        bool,
        typer.Option("--multiway", help="Of a release, for a bag: the multi-way graphs' edges."),
    ] = False,
) -> None:
    """Turn a folder of the NSS challenge or of the NSS release into a bag.

    Reads the field names of 2024 and 2025. Several graphs share their fragments and pairs in one
    bag. Ground truth goes to the topic ground_truth, which only the scorer reads. A release may
    become a dataset folder instead, for 'nss graphs', 'nss stats' and 'nss refine'. Of a simulated
    dataset without graphs, all fragments and the pairs that overlap go into the bag.
    """
    if folder.is_dir() and is_release(folder):
        release = read_release(folder)
        if gravity_aligned is None and release.manifest is not None:
            gravity_aligned = release.manifest.gravity_aligned
        if kind is Kind.DATASET:
            files = list(release.point_files.items())
            level = files_look_levelled(files) if gravity_aligned is None else gravity_aligned
            _import_dataset(release, output, level, json)
            return
        chosen = [str(name) for name in sets] if sets else list(SETS)
        challenge = as_challenge(release, split, chosen, multiway, graph)
        layout = "release"
    elif kind is Kind.BAG and _is_without_graphs(folder):
        if graph is not None or pairs is not PairChoice.AUTO or gravity_aligned is not None:
            raise InputError(
                f"{folder} is a dataset without pose graphs, of which --graph, --pairs and "
                f"--gravity-aligned are: run 'nss graphs {folder}' first, or leave them out."
            )
        _import_pairs(DatasetFolder(folder), output, json)
        return
    else:
        if kind is Kind.DATASET:
            raise InputError(
                f"{folder} is not a folder of the NSS release, which has annotations/<split>/"
                "<set>.json: only such a folder becomes a dataset."
            )
        challenge = read_folder(folder, graph, pairs)
        layout = "challenge folder"
    if gravity_aligned is None and (folder / MANIFEST_NAME).exists():  # of ours, and says it
        gravity_aligned = read_manifest(folder).gravity_aligned
    looked = gravity_aligned is None
    if gravity_aligned is None:
        gravity_aligned = files_look_levelled(list(challenge.point_files.items()))
    fragments = _Fragments(challenge, gravity_aligned, quiet=json, strict=layout == "release")
    metadata = {"source": f"NSS {layout} {folder.resolve().name}"}
    write_bag(
        output,
        fragments,
        challenge.pairs,
        challenge.ground_truth,
        metadata | challenge.metadata(),
    )
    summary = _summary(challenge, fragments, output) | {"gravity_aligned": gravity_aligned}
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
    if looked:
        files = list(challenge.point_files.items())
        axis = None if gravity_aligned else other_vertical_axis(files)
        console.print(
            _OTHER_VERTICAL.format(axis) if axis else _LOOKED[gravity_aligned], soft_wrap=True
        )
    console.print(f"Bag: {output}", soft_wrap=True, highlight=False)


def _import_dataset(release: Release, output: Path, gravity_aligned: bool, json: bool) -> None:
    with progress_bar(quiet=json) as progress:
        task = progress.add_task("fragments", total=None)
        dataset, sentences = as_dataset(
            release,
            output,
            gravity_aligned,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    fragments = len(dataset.fragment_ids())
    pairs = {
        split: {name: len(part) for name, part in parts.items()}
        for split, parts in release.annotations.items()
    }
    if json:
        summary = {"dataset": str(output), "fragments": fragments, "pairs": pairs}
        print_json(summary | {"left_out": list(sentences)})
        return
    console = Console()
    for split, counts in pairs.items():
        parts = ", ".join(f"{name} {count}" for name, count in counts.items())
        console.print(f"{split}, pairs: {parts}", highlight=False)
    for sentence in sentences:
        console.print(sentence, style="yellow", soft_wrap=True, highlight=False)
    console.print(f"{fragments} fragments. Dataset: {output}", soft_wrap=True, highlight=False)


class _Fragments:
    """The fragments of a folder, read one by one; counts what it has read."""

    def __init__(
        self, challenge: ChallengeFolder, gravity_aligned: bool, quiet: bool, strict: bool
    ) -> None:
        self._strict = strict
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
            if dropped and self._strict:
                raise FormatError(
                    f"{file} holds {dropped} points that are not finite: copy or export the file "
                    "again."
                )
            self.points += len(fragment.points)
            self.dropped += dropped
            yield fragment


def _is_without_graphs(folder: Path) -> bool:
    """A dataset of ours holds graphs only after 'nss graphs'; its other files are none."""
    return (folder / MANIFEST_NAME).exists() and not any((folder / GRAPH_FOLDER).rglob("*.json"))


def _import_pairs(dataset: DatasetFolder, output: Path, json: bool) -> None:
    """All fragments of a dataset and its pairs that overlap, as 'nss simulate --bag' has them."""
    (table,) = pair_sets(dataset, None).values()
    made = dataset.manifest.steps.get("pairs", {})
    config = validated(PairConfig, made.get("pairs", {}), MANIFEST_NAME)
    chosen = export_bag(output, dataset, table, config.min_overlap)
    counts = {"fragments": len(dataset.fragment_ids()), "pairs": len(chosen)}
    if json:
        print_json({"bag": str(output)} | counts)
        return
    Console().print(
        "Imported all {fragments} fragments of the dataset, which holds no pose graphs, and its "
        "{pairs} pairs that overlap.".format(**counts),
        f"Bag: {output}",
        sep="\n",
        soft_wrap=True,
        highlight=False,
    )


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
