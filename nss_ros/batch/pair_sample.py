"""A sample of the pairs of a dataset: those that overlap, and some that do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nss_ros.batch.plan import in_tiles
from nss_ros.dataset.pairs import PairTable
from nss_ros.fragment import FragmentId, FragmentPair


@dataclass(frozen=True, slots=True)
class PairSample:
    """What methods are compared on.

    Attributes:
        overlapping: pairs with ground truth, which recall counts.
        apart: pairs of one area that do not overlap; whether a method knows that is judged by
            the overlap probability, and its confidence in what it finds is calibrated on them.
    """

    overlapping: PairTable
    apart: tuple[FragmentPair, ...] = ()

    @property
    def pairs(self) -> tuple[FragmentPair, ...]:
        """All, in an order such that neighbours share fragments."""
        return in_tiles({*self.overlapping.pairs, *self.apart})


def sample_overlapping(pairs: PairTable, count: int, seed: int) -> PairTable:
    """At most `count` same-stage and `count` different-stage pairs, uniform among each kind."""
    same = pairs.same_stage
    drawn = [_drawn(np.flatnonzero(same == kind), count, (seed, kind)) for kind in (True, False)]
    return pairs.take(np.sort(np.concatenate(drawn)))


def sample_apart(
    fragments: Sequence[FragmentId], touching: PairTable, count: int, seed: int
) -> tuple[FragmentPair, ...]:
    """At most `count` pairs of one area that are none of those that touch.

    Args:
        fragments: of the dataset, in canonical order.
        touching: all pairs of the dataset that overlap at all.
        count: most pairs; some of an area without any are fewer.
        seed: of the sample.
    """
    known = {frozenset((pair.source, pair.target)) for pair in touching.pairs}
    found = [
        FragmentPair(source, target)
        for number, source in enumerate(fragments)
        for target in fragments[number + 1 :]
        if source.area == target.area and frozenset((source, target)) not in known
    ]
    chosen = _drawn(np.arange(len(found)), count, (seed, 2))
    return tuple(found[i] for i in sorted(chosen))


def _drawn(
    rows: np.ndarray[tuple[int], np.dtype[np.intp]], count: int, seed: tuple[int, ...]
) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return np.random.default_rng(seed).choice(rows, min(count, len(rows)), replace=False)
