"""Training, validation and test pairs, by the three splits of the NSS paper.

- original: drawn at random over all pairs (or fragments).
- cross_area: areas A, B, F (1, 2, 6) train, C, D, E (3, 4, 5) test; validation pairs are drawn
  from the training areas, or are those of areas of their own, as in the challenge (3).
- cross_stage: of each area the first half of the stages (rounded down, at least one) trains, the
  rest tests; pairs between the two halves are in no set, validation pairs are drawn from those
  that train.

An area that the settings do not name trains; if by the names no area trains or none tests, the
first half of all areas in natural order trains and the rest tests. An area with one stage trains.

What is random is a hash of the seed and the ids, so a pair's set depends neither on the order of
the pairs nor on which others there are; shares hold on average.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

import numpy as np

from nss_ros.config import SplitConfig
from nss_ros.dataset.pairs import PairTable, write_pairs
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair

SETS = ("train", "val", "test")

_SetOf = Callable[[FragmentPair], str | None]


class Split(StrEnum):
    """A way to divide a dataset."""

    ORIGINAL = "original"
    CROSS_AREA = "cross_area"
    CROSS_STAGE = "cross_stage"


def split_pairs(
    pairs: PairTable, split: Split, config: SplitConfig, seed: int
) -> dict[str, PairTable]:
    """The pairs of each set, "train", "val" and "test", in the order of the table.

    Args:
        pairs: all pairs of a dataset; which are selected stays as it is.
        split: the way to divide them.
        config: shares and areas.
        seed: of what is drawn.

    Raises:
        InputError: there is nothing to divide: one area (cross_area), or areas of one stage only
            (cross_stage).
    """
    makers = {
        Split.ORIGINAL: _original,
        Split.CROSS_AREA: _cross_area,
        Split.CROSS_STAGE: _cross_stage,
    }
    set_of = makers[split](pairs, config, seed)
    sets = np.array([set_of(pair) or "" for pair in pairs.pairs], dtype=object)
    return {name: pairs.take(sets == name) for name in SETS}


def write_split(folder: Path, sets: dict[str, PairTable]) -> None:
    """Write `<set>.csv` of each set, its selected pairs only, into a folder that is made.

    Raises:
        FormatError: the folder or a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"Cannot make the folder {folder}: {error.strerror}.") from error
    for name, pairs in sets.items():
        write_pairs(folder / f"{name}.csv", pairs.take(pairs.selected))


def _original(pairs: PairTable, config: SplitConfig, seed: int) -> _SetOf:  # noqa: ARG001
    def drawn(name: FragmentPair | FragmentId) -> str:
        draw = _draw(name, seed)
        if draw < config.train_share:
            return "train"
        return "val" if draw < config.train_share + config.validation_share else "test"

    def by_fragments(pair: FragmentPair) -> str | None:
        sets = {drawn(pair.source), drawn(pair.target)}
        return sets.pop() if len(sets) == 1 else None

    return drawn if config.original_by == "pairs" else by_fragments


def _cross_area(pairs: PairTable, config: SplitConfig, seed: int) -> _SetOf:
    sets = _area_sets(sorted({id_.area for id_ in pairs.source}, key=_natural), config)
    draw_validation = "val" not in sets.values()

    def set_of(pair: FragmentPair) -> str | None:
        name = sets[pair.source.area]
        return _validating(pair, config, seed) if name == "train" and draw_validation else name

    return set_of


def _area_sets(areas: list[str], config: SplitConfig) -> dict[str, str]:
    if len(areas) < 2:
        raise InputError(
            f"The split cross_area needs two areas that have pairs; there is {len(areas)}: "
            "simulate more areas, or use the split cross_stage."
        )
    named = dict.fromkeys(config.validation_areas, "val") | dict.fromkeys(config.test_areas, "test")
    sets = {area: named.get(area, "train") for area in areas}
    if not {"train", "test"} <= set(sets.values()):
        half = len(areas) // 2
        sets = {area: "train" if i < half else "test" for i, area in enumerate(areas)}
    return sets


def _cross_stage(pairs: PairTable, config: SplitConfig, seed: int) -> _SetOf:
    stages: dict[str, set[int]] = {}
    for id_ in (*pairs.source, *pairs.target):
        stages.setdefault(id_.area, set()).add(id_.stage)
    if not any(len(found) > 1 for found in stages.values()):
        raise InputError(
            "The split cross_stage needs an area with two stages that have pairs: simulate more "
            "stages, or use the split cross_area."
        )
    training = {area: sorted(all_)[: max(1, len(all_) // 2)] for area, all_ in stages.items()}

    def set_of(pair: FragmentPair) -> str | None:
        trains = {id_.stage in training[id_.area] for id_ in (pair.source, pair.target)}
        if len(trains) > 1:
            return None
        return _validating(pair, config, seed) if trains.pop() else "test"

    return set_of


def _validating(pair: FragmentPair, config: SplitConfig, seed: int) -> str:
    return "val" if _draw(pair, seed) < config.validation_share else "train"


def _draw(name: FragmentPair | FragmentId, seed: int) -> float:
    """A number in [0, 1) that belongs to a pair, in either direction, or to a fragment."""
    ids = sorted((name.source, name.target)) if isinstance(name, FragmentPair) else [name]
    digest = hashlib.sha256(f"{seed} {' '.join(map(str, ids))}".encode()).digest()
    return int.from_bytes(digest[:6], "big") / 2**48


def _natural(area: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", area)]
