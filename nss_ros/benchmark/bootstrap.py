"""Bootstrap: how far a figure would move with other pairs or fragments of the same kind.

Percentile intervals (Efron and Tibshirani, "An introduction to the bootstrap", chapter 13) from
resamplings with replacement, written as weights: how often each unit was drawn. Pairs share
fragments, so drawing pairs by themselves takes them for more independent than they are; drawing
fragments, and a pair as often as both of its fragments together, does not (Owen, "The pigeonhole
bootstrap", Annals of Applied Statistics 2007). A figure without spread in the sample, such as a
recall of 0 or 100 %, has an interval without width: the bootstrap cannot know better.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.benchmark.metrics import Floats

_BLOCK = 2**20  # weights in a block


@dataclass(frozen=True, slots=True)
class Bootstrap:
    """How to resample.

    Attributes:
        resamplings: number of resamplings; 0: no intervals.
        seed: of the resamplings.
        level: probability mass of the intervals, for example 0.95.
        by_fragment: draw fragments, and with them pairs, instead of pairs.
    """

    resamplings: int = 1000
    seed: int = 0
    level: float = 0.95
    by_fragment: bool = False


def resamplings(
    count: int, bootstrap: Bootstrap, members: NDArray[np.intp] | None = None
) -> Iterator[Floats]:
    """Weights of the units in all resamplings, in blocks of (some, count).

    Args:
        count: number of units.
        bootstrap: number of resamplings, seed, and whether `members` are drawn.
        members: (count, k) numbers from 0 of the fragments that a unit consists of; drawn
            instead of the units if the bootstrap is by fragment.
    """
    rng = np.random.default_rng(bootstrap.seed)
    clustered = bootstrap.by_fragment and members is not None and len(members) > 0
    drawn = int(members.max()) + 1 if clustered and members is not None else count
    size = max(1, _BLOCK // max(1, count))
    for begin in range(0, bootstrap.resamplings, size):
        weights = np.empty((min(size, bootstrap.resamplings - begin), count))
        for row in weights:
            times = np.bincount(rng.integers(drawn, size=drawn), minlength=drawn)
            row[:] = times[members].prod(axis=1) if clustered else times
        yield weights


def interval(values: Floats, level: float, units: int) -> tuple[float, float]:
    """The percentiles (1 - level) / 2 and (1 + level) / 2 of a figure's resampled values.

    NaN, where a resampling left the figure undefined, is left out. Fewer than two units tell
    nothing of spread: NaN.

    Args:
        values: (resamplings,).
        level: probability mass between the two.
        units: size of the sample that was resampled.
    """
    known = values[~np.isnan(values)]
    if units < 2 or len(known) == 0:
        return float("nan"), float("nan")
    low, high = np.percentile(known, (50 * (1 - level), 50 * (1 + level)))
    return float(low), float(high)


def p_value(differences: Floats) -> float:
    """Two-sided p-value of "there is no difference", from resampled paired differences.

    p = min(1, 2 (1 + min(#{d <= 0}, #{d >= 0})) / (1 + resamplings)), which is never zero, since
    finitely many resamplings cannot show that (Davison and Hinkley, "Bootstrap methods and their
    application", chapter 4). NaN where no difference is known.

    Args:
        differences: (resamplings,); NaN is left out.
    """
    known = differences[~np.isnan(differences)]
    if len(known) == 0:
        return float("nan")
    rarer = min(np.count_nonzero(known <= 0), np.count_nonzero(known >= 0))
    return float(min(1.0, 2 * (1 + rarer) / (1 + len(known))))
