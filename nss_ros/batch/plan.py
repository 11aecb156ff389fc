"""Which pairs of a dataset a benchmark registers, and in which logs they belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from nss_ros.dataset.annotate import pair_sets
from nss_ros.dataset.folder import PAIRS_NAME, DatasetFolder
from nss_ros.dataset.pairs import PairTable
from nss_ros.dataset.splits import Split
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair

# Neighbouring pairs share fragments, so that features are found in memory.
_TILE = 16


class BatchSplit(StrEnum):
    """Whose pairs are registered: the test pairs of a split, or all."""

    ORIGINAL = "original"
    CROSS_AREA = "cross_area"
    CROSS_STAGE = "cross_stage"
    ALL = "all"


class PairChoice(StrEnum):
    """Which pairs of a split are registered."""

    SELECTED = "selected"
    """The balanced choice of 'nss pairs', as in the pairwise table of the NSS paper."""
    OVERLAPPING = "overlapping"
    """All that overlap enough, as in its multi-way graphs."""


@dataclass(frozen=True, slots=True)
class Plan:
    """The pairs that are registered.

    Attributes:
        splits: pairs of each split, in the order of the dataset.
        pairs: those of all splits, each once, such that neighbours share fragments.
    """

    splits: dict[BatchSplit, PairTable]
    pairs: tuple[FragmentPair, ...]


def planned(
    dataset: DatasetFolder,
    splits: Sequence[BatchSplit],
    choice: PairChoice,
    min_overlap: float,
) -> Plan:
    """The pairs that a benchmark registers.

    Args:
        dataset: with `pairs.csv`.
        splits: of each the test pairs.
        choice: the selected pairs, or all that overlap.
        min_overlap: least overlap ratio of overlapping pairs.

    Raises:
        InputError: the dataset is not complete, lacks pairs, or does not allow a split.
        FormatError: the pairs cannot be read, or are not those of the dataset.
    """
    if not dataset.manifest.complete:
        raise InputError(
            f"{dataset.path} is not complete: finish it with the 'nss simulate' that began it."
        )
    tables = {split: _table(dataset, split, choice, min_overlap) for split in splits}
    pairs = in_tiles({pair for table in tables.values() for pair in table.pairs})
    known = set(dataset.fragment_ids())
    for pair in pairs:
        unknown = {pair.source, pair.target} - known
        if unknown:
            raise FormatError(
                f"{dataset.path / PAIRS_NAME} names {unknown.pop()}, which the dataset does not "
                f"have: run 'nss pairs {dataset.path}' again."
            )
    return Plan(tables, pairs)


def fragments_of(pairs: PairTable) -> list[FragmentId]:
    """The fragments of some pairs, in canonical order."""
    return sorted({*pairs.source.tolist(), *pairs.target.tolist()})


def in_tiles(pairs: set[FragmentPair]) -> tuple[FragmentPair, ...]:
    """Pairs in an order such that neighbours share fragments."""
    ids = sorted({id_ for pair in pairs for id_ in (pair.source, pair.target)})
    tile = {id_: number // _TILE for number, id_ in enumerate(ids)}
    return tuple(sorted(pairs, key=lambda pair: (tile[pair.source], tile[pair.target], pair)))


def _table(
    dataset: DatasetFolder, split: BatchSplit, choice: PairChoice, min_overlap: float
) -> PairTable:
    whole = split is BatchSplit.ALL
    sets = pair_sets(dataset, None if whole else Split(split))
    table = sets["all" if whole else "test"]
    chosen = table.selected if choice is PairChoice.SELECTED else table.overlap_ratio >= min_overlap
    if not chosen.any():
        raise InputError(
            f"The split {split} of {dataset.path} has no {choice} test pair: choose another "
            f"--split, or make more pairs with 'nss pairs {dataset.path}'."
        )
    return table.take(chosen)
