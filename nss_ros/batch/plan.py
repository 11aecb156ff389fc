"""Which pairs a benchmark registers, and in which logs they belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nss_ros.batch.source import BatchSplit, PairChoice, Source
from nss_ros.dataset.pairs import PairTable
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair

# Neighbouring pairs share fragments, so that features are found in memory.
_TILE = 16


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
    source: Source, splits: Sequence[BatchSplit], choice: PairChoice, min_overlap: float
) -> Plan:
    """The pairs that a benchmark registers.

    Args:
        source: a dataset with `pairs.csv`, or a bag.
        splits: of each the test pairs.
        choice: the selected pairs, or all that overlap.
        min_overlap: least overlap ratio of overlapping pairs.

    Raises:
        InputError: the dataset is not complete, lacks pairs, or does not allow a split.
        FormatError: the pairs cannot be read, or are not those of the dataset.
    """
    tables = {split: source.table(split, choice, min_overlap) for split in splits}
    for split, table in tables.items():
        if not len(table):
            raise InputError(
                f"The split {split} of {source.path} has no {choice} test pair: choose another "
                f"--split, or make more pairs with 'nss pairs {source.path}'."
            )
    return Plan(tables, in_tiles({pair for table in tables.values() for pair in table.pairs}))


def in_tiles(pairs: set[FragmentPair]) -> tuple[FragmentPair, ...]:
    """Pairs in an order such that neighbours share fragments."""
    ids = sorted({id_ for pair in pairs for id_ in (pair.source, pair.target)})
    tile = {id_: number // _TILE for number, id_ in enumerate(ids)}
    return tuple(sorted(pairs, key=lambda pair: (tile[pair.source], tile[pair.target], pair)))
