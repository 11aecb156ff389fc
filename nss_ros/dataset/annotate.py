"""What `nss pairs` and `nss graphs` add to a dataset folder; the manifest tells how it was made."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from nss_ros.config import GraphConfig, PairConfig, SplitConfig, validated
from nss_ros.dataset.challenge import ChallengeGraph
from nss_ros.dataset.folder import GRAPH_FOLDER, PAIRS_NAME, SPLIT_FOLDER, DatasetFolder
from nss_ros.dataset.graphs import challenge_graphs, multiway_graphs, write_graph_sets
from nss_ros.dataset.manifest import MANIFEST_NAME, current_versions, write_manifest
from nss_ros.dataset.pairs import PairTable, measure_pairs, read_pairs, write_pairs
from nss_ros.dataset.ply import count_vertices
from nss_ros.dataset.refinement import refined_transforms
from nss_ros.dataset.selection import select_pairs
from nss_ros.dataset.splits import SETS, Split, split_pairs, write_split
from nss_ros.errors import InputError
from nss_ros.parallel import Engine

MULTIWAY_FOLDER = "multiway_graph"

_WHOLE = "all"


class GraphKind(StrEnum):
    """What `add_graphs` makes."""

    CHALLENGE = "challenge"
    """Many graphs of 20 to 160 nodes with outliers, as in the challenge."""
    MULTIWAY = "multiway"
    """One graph per large connected component of each area, as in the paper."""


@dataclass(frozen=True, slots=True)
class SplitPairs:
    """The pairs of a dataset, and of each split.

    Attributes:
        pairs: all that overlap.
        splits: by split, the pairs of "train", "val" and "test".
        skipped: one sentence for each split that the dataset does not allow.
    """

    pairs: PairTable
    splits: dict[Split, dict[str, PairTable]]
    skipped: tuple[str, ...]


def add_pairs(
    dataset: DatasetFolder,
    config: PairConfig,
    splits: SplitConfig,
    seed: int,
    workers: int = 0,
    engine: Engine = Engine.LOCAL,
    report: Callable[[str, int, int], None] | None = None,
) -> SplitPairs:
    """Measure, select and split the pairs of a dataset; writes `pairs.csv` and `splits/`.

    Args:
        dataset: complete.
        config: distances, selection.
        splits: shares and areas.
        seed: of selection and splits.
        workers: processes; 0: one per core.
        engine: where they run.
        report: see `measure_pairs`.

    Raises:
        InputError: the dataset is not complete, or has no pair.
        FormatError: a file cannot be read or written.
    """
    _check_complete(dataset)
    ids = dataset.fragment_ids()
    files = {id_: dataset.point_file(id_) for id_ in ids}
    measured = measure_pairs(files, dataset.poses(), config, workers, engine, report)
    result = divided(select_pairs(measured, config, seed), splits, seed)
    write_pairs(dataset.path / PAIRS_NAME, result.pairs)
    shutil.rmtree(dataset.path / SPLIT_FOLDER, ignore_errors=True)  # of other settings
    for split, sets in result.splits.items():
        write_split(dataset.path / SPLIT_FOLDER / split, sets)
    settings = {"pairs": config.model_dump(mode="json"), "splits": splits.model_dump(mode="json")}
    _record(dataset, "pairs", seed, settings)
    return result


def divided(pairs: PairTable, config: SplitConfig, seed: int) -> SplitPairs:
    """The pairs by every split that they allow."""
    found: dict[Split, dict[str, PairTable]] = {}
    skipped = []
    for split in Split:
        try:
            found[split] = split_pairs(pairs, split, config, seed)
        except InputError as error:
            skipped.append(str(error))
    return SplitPairs(pairs, found, tuple(skipped))


@dataclass(frozen=True, slots=True)
class AddedGraphs:
    """The graphs of a dataset.

    Attributes:
        folder: where they were written, with one folder for each set.
        graphs: by set.
        skipped: one sentence for each area and set that gave fewer than asked for.
    """

    folder: Path
    graphs: dict[str, list[ChallengeGraph]]
    skipped: tuple[str, ...]


def add_graphs(
    dataset: DatasetFolder,
    kind: GraphKind,
    split: Split | None,
    config: GraphConfig,
    seed: int,
) -> AddedGraphs:
    """Make pose graphs from a dataset's pairs; of refined pairs, edges have the refined transform.

    Challenge graphs are written to `pose_graph/<set>/`, where `nss import` finds them, multi-way
    graphs to `multiway_graph/<split>/<set>/`. What was there before is replaced.

    Args:
        dataset: with `pairs.csv`.
        kind: what to make.
        split: whose sets; None: one set "all" of all pairs.
        config: sizes and limits.
        seed: of the challenge's graphs; the split is that of `nss pairs`.

    Raises:
        InputError: the dataset lacks pairs, or does not allow the split.
        FormatError: a file cannot be read or written.
    """
    _check_complete(dataset)
    sets = pair_sets(dataset, split)
    poses = dataset.poses()
    counts = {id_: count_vertices(dataset.point_file(id_)) for id_ in poses}
    refined = refined_transforms(dataset.path)
    if kind is GraphKind.CHALLENGE:
        made = challenge_graphs(sets, poses, config, seed, counts, refined=refined)
        folder = dataset.path / GRAPH_FOLDER
    else:
        made = multiway_graphs(sets, poses, config, counts, "Multiway", refined)
        folder = dataset.path / MULTIWAY_FOLDER / (split or _WHOLE)
    shutil.rmtree(folder, ignore_errors=True)
    write_graph_sets(folder, made.graphs)
    settings = {
        "split": split,
        "graphs": config.model_dump(mode="json"),
        "refined_pairs": len(refined) // 2,
    }
    _record(dataset, f"{kind}_graphs", seed, settings)
    return AddedGraphs(folder, made.graphs, made.skipped)


def pair_sets(dataset: DatasetFolder, split: Split | None) -> dict[str, PairTable]:
    """All pairs of each set of a split, selected or not; one set "all" without a split.

    Of an imported dataset, the sets hold the pairs that the release annotates.

    Raises:
        InputError: the dataset lacks pairs, or does not allow the split.
        FormatError: the pairs cannot be read.
    """
    path = dataset.path / PAIRS_NAME
    if not path.exists():
        raise InputError(f"{dataset.path} has no pairs yet: run 'nss pairs {dataset.path}' first.")
    pairs = read_pairs(path)
    if split is None:
        return {_WHOLE: pairs}
    made = dataset.manifest.steps.get("pairs", {})
    if made.get("imported"):  # the sets are somebody else's
        return _imported_sets(dataset, split)
    config = validated(SplitConfig, made.get("splits", {}), MANIFEST_NAME)
    return split_pairs(pairs, split, config, int(made.get("seed", 0)))


def sets_digest(dataset: DatasetFolder) -> str:
    """What tells whether two times the same pairs of a dataset are in the same sets."""
    made = dataset.manifest.steps.get("pairs", {})
    decisive = {name: made.get(name) for name in ("imported", "seed", "splits")}
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()[:16]


def _imported_sets(dataset: DatasetFolder, split: Split) -> dict[str, PairTable]:
    folder = dataset.path / SPLIT_FOLDER / split
    if not folder.is_dir():
        raise InputError(f"The release that {dataset.path} was made from has no split '{split}'.")
    return {name: read_pairs(folder / f"{name}.csv") for name in SETS}


def _check_complete(dataset: DatasetFolder) -> None:
    if not dataset.manifest.complete:
        raise InputError(
            f"{dataset.path} is not complete: finish it with the 'nss simulate' that began it."
        )


def _record(dataset: DatasetFolder, step: str, seed: int, settings: Mapping[str, Any]) -> None:
    steps = dataset.manifest.steps | {
        step: {"seed": seed, **settings, "versions": current_versions()}
    }
    dataset.manifest = dataset.manifest.model_copy(update={"steps": steps})
    write_manifest(dataset.path, dataset.manifest)
