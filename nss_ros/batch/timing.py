"""How long a method took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nss_ros.batch.journal import Journal
from nss_ros.fragment import FragmentPair


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of a method.

    Attributes:
        method: registered name.
        fragments: whose features were timed.
        prepare: mean seconds of a fragment's features; NaN of none.
        pairs: answered.
        failed: of these, pairs without a transform.
        register: mean seconds of a pair, features not included.
        median: median seconds of a pair.
    """

    method: str
    fragments: int
    prepare: float
    pairs: int
    failed: int
    register: float
    median: float

    @property
    def alone(self) -> float:
        """Mean seconds of a pair whose two fragments were never seen before."""
        return self.register + 2 * self.prepare


def timing_of(journal: Journal, method: str, pairs: Sequence[FragmentPair]) -> Timing:
    """The seconds of a method over pairs that it has answered."""
    results = [journal.of(method)[pair].result for pair in pairs]
    prepare = list(journal.prepare_seconds.get(method, {}).values())
    seconds = [result.compute_time for result in results]
    return Timing(
        method,
        len(prepare),
        float(np.mean(prepare)) if prepare else float("nan"),
        len(results),
        sum(not result.ok for result in results),
        float(np.mean(seconds)),
        float(np.median(seconds)),
    )
