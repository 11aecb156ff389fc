"""When the works are done: a common timeline of a construction floor, zone by zone.

Time is counted in steps of work, from the poured slab (0) to the floor in use (9). Each zone
runs through the same works, but not in step with the others: where one is at its studs,
another is closed. A renovation begins below zero with the floor in use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import SiteConfig

PROPS_OUT = 0.7
FACADE = 1.0
TRACKS = 1.8
FRAMES = 2.0
DUCTS = 2.4
STUDS = 2.7
PIPES = 2.9
GLAZING = 3.0
TRAYS = 3.2
ONE_SIDE = 3.8
CLOSED = 4.8
DOOR_FRAMES = 5.2
CEILING_GRIDS = 5.8
CEILING_TILES = 6.6
RAISED_FLOORS = 6.9
DOORS = 7.2
FURNITURE = 8.2

_STRIPPED = -0.3
_STRIP_PACE = 0.36  # steps of stripping per step of building
_PHASES = (
    (-2.0, "in use"),
    (0.0, "strip-out"),
    (1.8, "shell"),
    (2.8, "setting out"),
    (4.0, "stud walls"),
    (5.4, "boarding"),
    (7.4, "ceilings and doors"),
    (math.inf, "fit-out"),
)


@dataclass(frozen=True, slots=True)
class Programme:
    """How far each zone is at each stage.

    Attributes:
        times: (zones, stages) steps of work, not falling along the stages.
        former: whether it tells when the works of the layout before a renovation, all done at
            first, are stripped out again: what was built last goes first.
    """

    times: NDArray[np.float64]
    former: bool = False

    @property
    def stages(self) -> int:
        """Their number."""
        return int(self.times.shape[1])

    @property
    def always(self) -> frozenset[int]:
        """All stages."""
        return frozenset(range(1, self.stages + 1))

    def during(self, zone: int, start: float, end: float = math.inf) -> frozenset[int]:
        """The stages at which something is there.

        Args:
            zone: in which it is.
            start: when it is put in place, steps of work.
            end: when it is taken away again.
        """
        times = self.times[zone]
        if self.former:
            start, end = -math.inf, (-math.inf if end < math.inf else _stripped(start))
        return frozenset((np.flatnonzero((times >= start) & (times < end)) + 1).tolist())


def draw_programme(
    config: SiteConfig, zones: NDArray[np.float64], rng: np.random.Generator
) -> Programme:
    """A programme for zones that are worked through one after another.

    Args:
        config: number of stages, pace, stagger, renovation.
        zones: (n,) in [-1, 1], place of each in the order of work.
        rng: of the delays.
    """
    common = _common(config)
    order = zones * rng.choice([-1.0, 1.0])
    lags = config.stagger * (0.7 * order + rng.normal(0.0, 0.55, len(zones)))
    slips = config.stagger * rng.normal(0.0, 0.25, (len(zones), len(common)))
    return Programme(np.maximum.accumulate(common - lags[:, None] + slips, axis=1))


def stage_names(config: SiteConfig) -> tuple[str, ...]:
    """What is being done at each stage, on the whole."""
    return tuple(
        next(name for end, name in _PHASES if time < end) for time in _common(config).tolist()
    )


def _common(config: SiteConfig) -> NDArray[np.float64]:
    first, last = (-2.9 if config.renovation else 1.0), 9.0
    span = min(last - first, 3.9 * config.pace * (config.stages - 1))
    middle = (first + last) / 2
    return np.linspace(middle - span / 2, middle + span / 2, config.stages)


def _stripped(start: float) -> float:
    return _STRIPPED - _STRIP_PACE * max(start - TRACKS, 0.0)
