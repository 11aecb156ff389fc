"""When fragments, pairs and answers came, by the recorder's clock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nss_ros import topics
from nss_ros.bag_reader import BagReader, decode
from nss_ros.benchmark.metrics import Floats
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair
from nss_ros.messages import pair_from


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


def read_timing(path: Path) -> RunTiming:
    """The times of a log.

    Raises:
        BagError: there is no log, or it cannot be read.
    """
    fragments: list[float] = []
    requests: dict[FragmentPair, float] = {}
    answers: dict[FragmentPair, tuple[float, float]] = {}
    begin: int | None = None
    for message in BagReader(path).messages():
        begin = message.stamp if begin is None else min(begin, message.stamp)
        stamp = message.stamp / 1e9
        if message.type == topics.FRAGMENTS.type:
            fragments.append(stamp)
        elif message.type in (topics.FRAGMENT_PAIRS.type, topics.RELATIVE_TRANSFORMS.type):
            content = decode(message)
            try:
                pair = pair_from(content)
            except InputError:
                continue
            if message.type == topics.FRAGMENT_PAIRS.type:
                requests.setdefault(pair, stamp)
            else:
                answers.setdefault(pair, (stamp, float(content.compute_time)))
    start = (begin or 0) / 1e9
    ordered = sorted(answers.items(), key=lambda item: item[1][0])
    arrived = np.array([arrival for _, (arrival, _) in ordered])
    asked = np.array([requests.get(pair, np.nan) for pair, _ in ordered])
    compute_time = np.array([seconds for _, (_, seconds) in ordered])
    latency = arrived - asked
    # An answer cannot come sooner than it is computed: the request was heard of late.
    latency[latency < compute_time] = np.nan
    return RunTiming(
        fragments=np.sort(np.array(fragments)) - start,
        requests=np.sort(np.array(list(requests.values()))) - start,
        pairs=tuple(pair for pair, _ in ordered),
        answers=arrived - start,
        latency=latency,
        compute_time=compute_time,
    )
