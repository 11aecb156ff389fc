"""Throughput and latency over the time of a run."""

from __future__ import annotations

import numpy as np

from nss_ros.benchmark.chart import MAX_POINTS, Axis, Chart, Mark, Panel, Series, spread
from nss_ros.benchmark.metrics import Floats
from nss_ros.benchmark.run_timing import RunTiming

_WINDOWS = 40  # in which throughput is counted


def timing_chart(times: RunTiming) -> Chart | None:
    """Throughput and latency over the time of the run; None without answers."""
    if not len(times.answers):
        return None
    end = float(max(times.answers[-1], *times.requests[-1:], *times.fragments[-1:]))
    clock = Axis("time (s)", 0.0, end * 1.02 or 1.0)
    flow = [
        _count("fragments received", times.fragments, "#009E73"),
        _count("pairs asked for", times.requests, "#999999"),
        _count("pairs answered", times.answers, "#0072B2"),
    ]
    edges = np.linspace(0, end or 1.0, _WINDOWS + 1)
    rate = np.asarray(np.histogram(times.answers, edges)[0] / np.diff(edges), dtype=np.float64)
    middle = np.asarray((edges[1:] + edges[:-1]) / 2, dtype=np.float64)
    chosen = spread(len(times.answers), MAX_POINTS)
    known = chosen[np.isfinite(times.latency[chosen])]
    waits = (
        Series(
            "request to answer",
            times.answers[known],
            times.latency[known],
            "#E69F00",
            Mark.POINTS,
            _waits(times, known),
            size=4,
            alpha=0.8,
        ),
        Series(
            "of this, computing",
            times.answers[chosen],
            times.compute_time[chosen],
            "#CC79A7",
            Mark.POINTS,
            _waits(times, chosen),
            size=4,
            alpha=0.8,
        ),
    )
    speed = Series(
        "",
        middle,
        rate,
        "#0072B2",
        Mark.BARS,
        tuple(f"{t:.1f} s<br>{r:.2f} pairs a second" for t, r in zip(middle, rate, strict=True)),
        width=float(edges[1]) * 0.92,
        alpha=0.75,
    )
    late = int((~np.isfinite(times.latency)).sum())
    unheard = f" Of {late:,} answers the recorder did not hear the request in time." if late else ""
    return Chart(
        "Throughput and latency",
        (
            Panel(clock, Axis("count", 0.0), tuple(s for s in flow if len(s.x)), "Received"),
            Panel(clock, Axis("pairs per second", 0.0), (speed,), "Throughput"),
            Panel(
                clock,
                Axis("seconds", log=True),
                tuple(s for s in waits if len(s.x)),
                "Latency of each answer",
            ),
        ),
        "By the recorder's clock, from the first message of the log." + unheard,
        columns=3,
    )


def _count(name: str, times: Floats, colour: str) -> Series:
    chosen = spread(len(times)) if len(times) else np.zeros(0, dtype=np.intp)
    return Series(name, times[chosen], (chosen + 1).astype(np.float64), colour)


def _waits(times: RunTiming, chosen: np.ndarray[tuple[int], np.dtype[np.intp]]) -> tuple[str, ...]:
    return tuple(
        f"{times.pairs[i].source}<br>→ {times.pairs[i].target}<br>waited "
        f"{times.latency[i]:.2f} s, computed {times.compute_time[i]:.2f} s"
        for i in chosen
    )
