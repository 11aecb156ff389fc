"""When fragments, pairs and answers came, by the recorder's clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nss_ros.bag import Log
from nss_ros.benchmark.metrics import Floats
from nss_ros.fragment import FragmentPair


@dataclass(frozen=True, slots=True, eq=False)
class RunTiming:
    """Times in seconds since the first message of the log.

    Attributes:
        fragments: (f,) arrivals of fragments, ascending; empty if they were not recorded.
        requests: (r,) arrivals of pairs that were asked for, ascending.
        pairs: (n,) pairs that were answered, in the order of their answers.
        answers: (n,) arrivals of the answers, ascending.
        latency: (n,) from request to answer, seconds; NaN where the recorder did not hear of the
            request in time (a latched topic is heard late after the recorder's start).
        compute_time: (n,) seconds that the method took, as it reported.
    """

    fragments: Floats
    requests: Floats
    pairs: tuple[FragmentPair, ...]
    answers: Floats
    latency: Floats
    compute_time: Floats


def timing_of(log: Log) -> RunTiming:
    """The times of a log that was read with its points."""
    arrivals = log.arrivals
    ordered = sorted(arrivals.relative_transforms.items(), key=lambda item: item[1])
    arrived = np.array([stamp for _, stamp in ordered]) / 1e9
    asked = np.array([arrivals.pairs.get(pair, np.nan) for pair, _ in ordered]) / 1e9
    compute_time = np.array([log.relative_transforms[pair].compute_time for pair, _ in ordered])
    latency = arrived - asked
    # An answer cannot come sooner than it is computed: the request was heard of late.
    latency[latency < compute_time] = np.nan
    start = arrivals.begin / 1e9
    return RunTiming(
        fragments=np.sort(np.array(arrivals.fragments) / 1e9) - start,
        requests=np.sort(np.array(list(arrivals.pairs.values())) / 1e9) - start,
        pairs=tuple(pair for pair, _ in ordered),
        answers=arrived - start,
        latency=latency,
        compute_time=compute_time,
    )
