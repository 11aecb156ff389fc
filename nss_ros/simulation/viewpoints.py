"""Where the tripod is put: on free, reachable floor, until all of it has been seen.

The NSS paper's fragment generation: places are drawn with a probability that grows with their
distance from obstacles, 1 to 4 m apart, until coverage stops growing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import ViewpointConfig
from nss_ros.errors import InputError
from nss_ros.simulation.occupancy import OccupancyMap

_MOST_WEIGHT = 2.0
"""Places farther than this from obstacles are not favoured any more, metres."""
_SAME_VIEW = 0.5
"""A place this near to one that sees nothing new is not tried, metres."""
_DRAWS = 64
"""Places drawn at a time."""
_NEAR_START = 3
"""The first spot is at most this many of the longest spacings farther than it must."""
_WORTH_TELLING = 10.0
"""Floor that nobody can reach is told from this size on; shafts are smaller, square metres."""


def choose_viewpoints(
    occupancy: OccupancyMap,
    config: ViewpointConfig,
    view_range: float,
    rng: np.random.Generator,
    start: tuple[float, float] | None = None,
) -> NDArray[np.float64]:
    """Spots, (n, 3): x, y and the z of the floor there, metres, map frame, in order of choice.

    All but the first spot of a region have an earlier one within `max_spacing`, in sight if any
    such place sees enough that is new. No further spot is added that sees less than
    `least_gain` of floor that none has seen yet.

    Args:
        occupancy: the map of the stage.
        config: spacing, clearance, and when to stop.
        view_range: how far a spot sees, metres.
        rng: of the draws.
        start: x and y, metres, map frame, near which the first spot is; None: anywhere.

    Raises:
        InputError: there is no free floor to stand on; the message names the setting.
    """
    clearance = occupancy.clearance()
    standing = clearance >= config.min_clearance
    spots: list[tuple[int, int]] = []
    regions = occupancy.reachable(config.passage, config.min_region)
    away = _distances(occupancy, start)
    if start is not None:
        regions.sort(key=lambda region: float(away[region].min()))
    for region in regions:
        weight = np.where(region & standing, np.minimum(clearance, _MOST_WEIGHT), 0.0)
        most = config.spots_per_stage - len(spots) if config.spots_per_stage else len(weight.flat)
        reach = away[weight > 0].min(initial=math.inf) + _NEAR_START * config.max_spacing
        search = _Search(occupancy, region, weight, away <= reach, view_range, config)
        spots += search.spots(most, rng)
    if not spots:
        raise InputError(
            f"no free floor to stand on with {config.min_clearance} m of clearance: lower "
            "simulation.viewpoints.min_clearance, or mend the site's extent or floor height"
        )
    cells = np.array(spots)
    return np.column_stack((occupancy.centres(cells), occupancy.surface[tuple(cells.T)]))


def unreached_floor(occupancy: OccupancyMap, config: ViewpointConfig) -> list[float]:
    """Free regions that get no spot because they are cut off: sizes in square metres, falling.

    Told are those of 10 m2 and more in which a tripod could stand.

    Args:
        occupancy: the map of the stage.
        config: as `choose_viewpoints` takes it.
    """
    standing = occupancy.clearance() >= config.min_clearance
    reached = np.zeros_like(standing)
    for region in occupancy.reachable(config.passage, config.min_region):
        reached |= region
    told: list[float] = []
    for region in occupancy.regions(config.passage):
        size = float(np.count_nonzero(region)) * occupancy.cell_size**2
        if size < _WORTH_TELLING:  # as are all that follow
            break
        if not (region & reached).any() and (region & standing).any():
            told.append(size)
    return told


class _Search:
    """The choice of spots in one region; its maps are padded by the reach of a spot.

    Args:
        occupancy: the map of the stage.
        region: (nx, ny) floor to be seen.
        weight: (nx, ny) chance of a cell to be drawn; 0 where no tripod can stand.
        begin: (nx, ny) where the first spot may be.
        view_range: metres.
        config: spacing and least gain.
    """

    def __init__(
        self,
        occupancy: OccupancyMap,
        region: NDArray[np.bool_],
        weight: NDArray[np.float64],
        begin: NDArray[np.bool_],
        view_range: float,
        config: ViewpointConfig,
    ) -> None:
        cell = occupancy.cell_size
        self._reach = math.ceil(max(view_range, config.max_spacing) / cell)
        self._occupied = np.pad(occupancy.occupied, self._reach, constant_values=True)
        self._unseen = np.pad(region, self._reach)
        self._weight = np.pad(weight, self._reach)
        self._begin = np.pad(begin, self._reach)
        self._close = np.zeros_like(self._unseen)
        self._in_sight = np.zeros_like(self._unseen)
        self._rays = _sight_rays(round(view_range / cell))
        offsets = np.arange(-self._reach, self._reach + 1)
        self._distance = np.hypot(offsets[:, None], offsets) * cell
        self._spacing = (config.min_spacing, config.max_spacing)
        self._least_gain = config.least_gain / cell**2

    def spots(self, most: int, rng: np.random.Generator) -> list[tuple[int, int]]:
        """Cells of at most so many spots."""
        found: list[tuple[int, int]] = []
        while len(found) < most:
            places = self._draw(rng, first=not found)
            if not places:
                break
            place = next((p for p in places if self._try(p, first=not found)), None)
            if place is not None:
                found.append((place[0] - self._reach, place[1] - self._reach))
        return found

    def _draw(self, rng: np.random.Generator, first: bool) -> list[tuple[int, int]]:
        """Some places, drawn by their chance, each once; none if there are none left."""
        if not first:
            return self._drawn(self._in_sight, rng) or self._drawn(self._close, rng)
        anywhere = self._drawn(np.ones_like(self._begin), rng)
        return [each for each in anywhere if self._begin[each]] or self._drawn(self._begin, rng)

    def _drawn(self, allowed: NDArray[np.bool_], rng: np.random.Generator) -> list[tuple[int, int]]:
        chance = np.where(allowed, self._weight, 0.0)
        total = np.cumsum(chance)
        if total[-1] == 0:
            return []
        drawn = np.searchsorted(total, rng.random(_DRAWS) * total[-1], side="right")
        i, j = np.unravel_index(np.minimum(drawn, chance.size - 1), chance.shape)
        return list(dict.fromkeys(zip(i.tolist(), j.tolist(), strict=True)))

    def _try(self, place: tuple[int, int], first: bool) -> bool:
        """Make a place a spot if it sees enough, else rule it out with those around it."""
        i, j = place
        if self._weight[place] == 0:  # ruled out since it was drawn
            return False
        window = (
            slice(i - self._reach, i + self._reach + 1),
            slice(j - self._reach, j + self._reach + 1),
        )
        visible = self._visible(place)
        gain = np.count_nonzero(self._unseen[window] & visible)
        if gain < self._least_gain and not first:
            self._weight[window][self._distance < _SAME_VIEW] = 0
            return False
        shortest, longest = self._spacing
        self._unseen[window] &= ~visible
        self._weight[window][self._distance < shortest] = 0
        self._close[window] |= self._distance <= longest
        self._in_sight[window] |= visible & (self._distance <= longest)
        return True

    def _visible(self, place: tuple[int, int]) -> NDArray[np.bool_]:
        """What is seen of the window around a place, by going along rays up to an obstacle."""
        i, j = self._rays
        blocked = self._occupied[place[0] + i, place[1] + j]
        seen = ~np.logical_or.accumulate(blocked, axis=1)
        visible = np.zeros_like(self._distance, dtype=bool)
        visible[i[seen] + self._reach, j[seen] + self._reach] = True
        return visible


def _distances(occupancy: OccupancyMap, start: tuple[float, float] | None) -> NDArray[np.float64]:
    """How far each cell is from a place, (nx, ny), metres; 0 without one."""
    shape = occupancy.occupied.shape
    if start is None:
        return np.zeros(shape)
    cells = np.indices(shape, dtype=np.int64).reshape(2, -1).T
    away = np.hypot(*(occupancy.centres(cells) - np.array(start)).T)
    return np.asarray(away.reshape(shape))


def _sight_rays(reach: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells along rays in all directions, two arrays (rays, steps), from the place outwards.

    Neighbouring rays are a cell apart at their ends.
    """
    count = math.ceil(2 * np.pi * reach)
    angles = np.arange(count) * (2 * np.pi / count)
    steps = np.arange(reach + 1)
    return (
        np.rint(np.outer(np.cos(angles), steps)).astype(np.int64),
        np.rint(np.outer(np.sin(angles), steps)).astype(np.int64),
    )
