"""Submaps joined to larger ones, the surest link first.

The fragments of each stage are joined by their pairs where these are sure; the submaps that come
of it are registered with each other, and each that is joined makes the next ones surer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import combinations

import numpy as np

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, from_up, inverse
from nss_ros.multiway.agglomeration import LARGE, Ambiguous, Loss, joined_parts
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.contradictions import are_usual, loss_of_pair, loss_of_parts, noise_of
from nss_ros.multiway.pose_graph import Alternative, Measurement
from nss_ros.multiway.spacing import count_on_same_place, loss_on_same_place, on_same_place
from nss_ros.multiway.spanning_tree import Poses
from nss_ros.multiway.submap import (
    NO_CONFLICT,
    WIDE_NONE,
    Submap,
    SubmapLink,
    conflict_loss,
    polished,
    register_submaps,
)
from nss_ros.multiway.submap_fragment import Fragments
from nss_ros.registration.gravity.agreement import agreement

# Logarithm of the odds above which the pairs of one stage alone join fragments, and above which
# submaps are joined.
_SURE_PAIRS, _LEAST_ODDS = 3.0, 0.0
# Of two submaps that both are large: joined wrongly, half of a map is. Of eight such links with
# less than 7, of four sites, the three with less than 1 were wrong.
_LEAST_OF_LARGE = 2.0
# A fragment that saw little, in the middle of a hall for example, fits some place of a large submap
# with less than this: of 28 such, in four buildings, 15 were in their place. They come last, and
# none by what another of them says, or one that is wrong has others go wrong.
_DOUBTFUL = 3.0
# Submaps between which no pair was asked for may well not touch: logarithm of the odds of that,
# at least. Fragments with less than this between their sensors, metres, tell how much they are;
# of them a share is never asked for.
_UNASKED, _BESIDE, _MOST_ASKED = 6.0, 2.5, 0.9
# Links of small submaps are measured when no link of a larger one is left.
_LATER = -1000.0
# Pairs within a stage that are this probable tell what is noise of what scanners see.
_PROBABLE = 0.8
# Those above this tell whether tripods stand apart: wrong poses lie on each other by chance.
_SURE_ALONE = 0.95
# Logarithm of the odds from which it counts more how large the submaps of a link are than how sure
# it is. Links of two large ones come first, also those that are only fairly sure: what single
# fragments add would only speak against them.
_SURE, _FAIRLY_SURE, _BETWEEN_LARGE = 6.0, 3.0, 1e6
# What a link is thought to have until it is measured: more than any, so that the largest are first.
_UNMEASURED = 500.0


@dataclass(frozen=True, slots=True)
class Joined:
    """Submaps after all that is sure has been joined.

    Attributes:
        parts: poses of the fragments of each, in a frame of its own; largest first.
        doubtful: fragments that are where they are by little.
    """

    parts: list[Poses]
    doubtful: frozenset[FragmentId]


def joined_submaps(
    fragments: Iterable[FragmentId],
    measurements: Sequence[Measurement],
    prepared: Fragments,
    choi: Choi,
) -> Joined:
    """Submaps joined to larger ones while there is something that speaks for it.

    Args:
        fragments: all of them.
        measurements: between them, with their alternatives.
        prepared: the fragments.
        choi: tells when poses agree, and straightens what pairs of one stage join.
    """
    joining = Joining(fragments, measurements, prepared, choi)
    for _ in joining:
        pass
    return Joined(joining.parts(), frozenset(joining.doubtful))


class Joining:
    """Submaps that are being joined; iterating joins two at a time."""

    def __init__(
        self,
        fragments: Iterable[FragmentId],
        measurements: Sequence[Measurement],
        prepared: Fragments,
        choi: Choi,
    ) -> None:
        probable = [m for m in measurements if m.pair.same_stage and m.confidence > _PROBABLE]
        self._noise = _noise(probable, prepared)
        self._same_place_loss = loss_on_same_place(
            m.T_target_source for m in probable if m.confidence > _SURE_ALONE
        )
        within = [
            _doubted(m, prepared, self._noise, self._same_place_loss)
            for m in measurements
            if m.pair.same_stage
        ]

        def loss(one: Poses, other: Poses, transform: Transform) -> float:
            seen = loss_of_parts(one, other, transform, prepared, self._noise)
            return seen + self._same_place_loss * count_on_same_place(one, other, transform)

        parts = _straight_parts(list(fragments), within, choi, loss)
        self._prepared, self._close = prepared, choi.close
        self.doubtful: set[FragmentId] = set()
        self._asked = {frozenset((m.pair.source, m.pair.target)) for m in measurements}
        self.submaps = {n: Submap.of(_levelled(part), prepared) for n, part in enumerate(parts)}
        self._pairs: dict[int, dict[int, list[Ambiguous]]] = {n: {} for n in self.submaps}
        # A link that was not measured yet, or before one of its submaps grew, has no transform.
        self._links: dict[tuple[int, int], SubmapLink | None] = {}
        self._queue: list[tuple[float, int, int, float]] = []
        self._add_pairs(measurements)

    def parts(self) -> list[Poses]:
        """Poses of the fragments of each submap, largest first."""
        all_ = [submap.poses for submap in self.submaps.values()]
        return sorted(all_, key=lambda part: (-len(part), min(part)))

    def __iter__(self) -> Iterator[tuple[float, Submap, Submap, SubmapLink]]:
        yield from self._join_while_sure()
        self._link_unasked()
        yield from self._join_while_sure()
        yield from self._join_doubtful()

    def _join_while_sure(self) -> Iterator[tuple[float, Submap, Submap, SubmapLink]]:
        while self._queue:
            _, one, other, odds = heappop(self._queue)
            if one not in self.submaps or other not in self.submaps:
                continue
            link = self._links[one, other]
            if link is None:
                self._measure(one, other)
            elif link.odds == odds:
                if link.odds < _LEAST_ODDS:
                    return
                if self._is_doubtful(odds, one, other) or self._is_weak(odds, one, other):
                    continue
                yield link.odds, self.submaps[one], self.submaps[other], link
                self._join(one, other, link)

    def _join_doubtful(self) -> Iterator[tuple[float, Submap, Submap, SubmapLink]]:
        """Single fragments that fit by little, where they fit best beside all that is sure."""
        links = [
            (link, one, other)
            for (one, other), link in self._links.items()
            if link is not None and self._is_doubtful(link.odds, one, other)
        ]
        for link, one, other in sorted(links, key=lambda each: (-each[0].odds, *each[1:])):
            if one in self.submaps and other in self.submaps:
                yield link.odds, self.submaps[one], self.submaps[other], link
                small = min((self.submaps[each].poses for each in (one, other)), key=len)
                self.doubtful.update(small)
                self._join(one, other, link)

    def _is_doubtful(self, odds: float, one: int, other: int) -> bool:
        """Whether a single fragment fits a large submap, but so little that it may be by chance."""
        small, large = sorted(len(self.submaps[each].poses) for each in (one, other))
        return small == 1 and large >= LARGE and _LEAST_ODDS <= odds < _DOUBTFUL

    def _is_weak(self, odds: float, one: int, other: int) -> bool:
        """Whether too little speaks for a link of two large submaps."""
        small = min(len(self.submaps[each].poses) for each in (one, other))
        return small >= LARGE and odds < _LEAST_OF_LARGE

    def _link_unasked(self) -> None:
        """Links of large submaps of one area between which no pair was asked for."""
        large = [n for n, submap in sorted(self.submaps.items()) if len(submap.poses) >= LARGE]
        for one, other in combinations(large, 2):
            areas = [next(iter(self.submaps[each].poses)).area for each in (one, other)]
            if areas[0] == areas[1] and (one, other) not in self._links:
                self._pairs[one][other], self._pairs[other][one] = [], []
                self._links[one, other] = None
                self._wait(np.inf, one, other)

    def _add_pairs(self, measurements: Sequence[Measurement]) -> None:
        part = {id_: n for n, submap in self.submaps.items() for id_ in submap.poses}
        for m in measurements:
            one, other = part[m.pair.target], part[m.pair.source]
            if one != other:
                pair = Ambiguous.of(m)
                self._pairs[one].setdefault(other, []).append(pair)
                self._pairs[other].setdefault(one, []).append(pair)
        for one, beside in self._pairs.items():
            for other in beside:
                if one < other:
                    self._links[one, other] = None
                    self._wait(self._guess(one, other), one, other)

    def _wait(self, priority: float, one: int, other: int, odds: float = np.nan) -> None:
        """Let a link wait for its turn, with its odds if it was measured."""
        heappush(self._queue, (-priority, one, other, odds))

    def _guess(self, one: int, other: int) -> float:
        """Priority of a link that was not measured: as if it were sure, last if both are small."""
        sizes = [len(self.submaps[each].poses) for each in (one, other)]
        if max(sizes) < LARGE:
            return _LATER + sum(sizes)
        return self._priority(_UNMEASURED, one, other)

    def _priority(self, odds: float, one: int, other: int) -> float:
        """What is joined first: of sure links those of large submaps, the largest, then the surest.

        A small submap fits in several like rooms of another, and better in the right one of a
        submap that has all of them.
        """
        sizes = [len(self.submaps[each].poses) for each in (one, other)]
        large = min(sizes) >= LARGE
        if not (_FAIRLY_SURE if large else _SURE) < odds < np.inf:
            return odds
        tier = _BETWEEN_LARGE * (1 + (odds > _SURE)) if large else _SURE
        return tier + sum(sizes) + odds * 1e-3

    def _measure(self, one: int, other: int) -> None:
        """The link that moves the second submap to the first."""
        pairs = self._pairs[one][other]
        link = register_submaps(
            self.submaps[other],
            self.submaps[one],
            pairs,
            self._close,
            self._noise,
            self._same_place_loss,
        )
        if not pairs:
            silence = self._silence(self.submaps[one], self.submaps[other], link.T_target_source)
            link = replace(link, odds=link.odds - max(silence, _UNASKED))
        self._links[one, other] = link
        self._wait(self._priority(link.odds, one, other), one, other, link.odds)

    def _silence(self, target: Submap, source: Submap, T_target_source: Transform) -> float:
        """Logarithm of the odds that a pair would have been asked for, were this link right.

        Of fragments beside each other, that share of the pairs is asked for that it is within
        submaps. Two like dwellings fit on one another as well as one dwelling on itself; only
        that nobody asks for pairs of them tells.
        """
        beside: Counter[tuple[int, int]] = Counter()
        asked: Counter[tuple[int, int]] = Counter()
        for submap in self.submaps.values():
            for one, other in _pairs_beside(submap.poses, submap.poses):
                beside[_stages(one, other)] += 1
                asked[_stages(one, other)] += frozenset((one, other)) in self._asked
        moved = {id_: T_target_source @ pose for id_, pose in source.poses.items()}
        between = Counter(_stages(*pair) for pair in _pairs_beside(moved, target.poses))
        shares = {each: min(asked[each] / (beside[each] + 1), _MOST_ASKED) for each in between}
        return -sum(count * float(np.log1p(-shares[each])) for each, count in between.items())

    def _join(self, one: int, other: int, link: SubmapLink) -> None:
        """Make one submap of two, in the frame of the larger one."""
        link = polished(
            link,
            self.submaps[other],
            self.submaps[one],
            self._pairs[one][other],
            self._close,
            self._same_place_loss,
        )
        transform = link.T_target_source
        if len(self.submaps[other].poses) > len(self.submaps[one].poses):
            one, other, transform = other, one, inverse(transform)
        added = self.submaps.pop(other)
        self.submaps[one] = self.submaps[one].joined(added, transform, self._prepared)
        for third, between in self._pairs.pop(other).items():
            del self._pairs[third][other]
            known = self._links.pop((min(other, third), max(other, third)))
            if third == one:
                continue
            self._pairs[one].setdefault(third, []).extend(between)
            self._pairs[third].setdefault(one, []).extend(between)
            # What an old link says is about how sure the new one is, until it is measured.
            key = (min(one, third), max(one, third))
            old = [each.odds for each in (known, self._links.get(key)) if each is not None]
            self._links[key] = None
            odds = max(old, default=None)
            priority = self._guess(*key) if odds is None else self._priority(odds, *key)
            self._wait(priority, *key)


def _straight_parts(
    fragments: Sequence[FragmentId], within: Sequence[Measurement], choi: Choi, loss: Loss
) -> list[Poses]:
    """What pairs of one stage join surely: straightened, parts fit each other better."""
    parts: list[Poses] = []
    while True:
        joined = joined_parts(fragments, within, choi.close, _SURE_PAIRS, parts, loss)
        if len(joined) == len(parts):
            return joined
        parts = [choi.straightened(part, within) if len(part) > 1 else part for part in joined]


def _levelled(part: Poses) -> Poses:
    """A part in a frame whose z axis is the mean of those of its fragments.

    That of one tripod is half a degree off, which at the other end of a floor is decimetres.
    """
    mean = np.mean([pose[:3, 2] for pose in part.values()], axis=0)
    level = inverse(from_up(mean))
    return {id_: level @ pose for id_, pose in part.items()}


def _noise(probable: Sequence[Measurement], prepared: Fragments) -> float:
    """What probable pairs of one stage have of contradictions."""
    scans = [(prepared[m.pair.source], prepared[m.pair.target]) for m in probable]
    return noise_of(
        (*both, m.T_target_source)
        for m, both in zip(probable, scans, strict=True)
        if are_usual(*both) and not m.manual
    )


def _doubted(
    m: Measurement, prepared: Fragments, noise: float, same_place_loss: float
) -> Measurement:
    """A measurement within a stage, its hypotheses less probable the more conflict they have."""
    if m.manual:
        return m
    first = Alternative(m.T_target_source, m.information, m.confidence)
    listed = (first, *m.alternatives)
    transforms = [each.T_target_source for each in listed]
    losses = [
        loss + same_place_loss * on_same_place(each)
        for loss, each in zip(_losses(m, transforms, prepared, noise), transforms, strict=True)
    ]
    ranked = [
        replace(each, probability=each.probability * math.exp(-loss))
        for each, loss in zip(listed, losses, strict=True)
    ]
    best, *rest = sorted(ranked, key=lambda each: -each.probability)
    return replace(
        m,
        T_target_source=best.T_target_source,
        information=best.information,
        confidence=best.probability,
        alternatives=tuple(rest),
    )


def _losses(
    m: Measurement, transforms: Sequence[Transform], prepared: Fragments, noise: float
) -> list[float]:
    """What hypotheses lose by what their scanners saw, logarithm."""
    source, target = prepared[m.pair.source], prepared[m.pair.target]
    if are_usual(source, target):
        return [loss_of_pair(source, target, each, noise) for each in transforms]
    conflicts = [agreement(source.view, target.view, each).conflict for each in transforms]
    # People and glass are noise of every hypothesis.
    every = float(np.clip(min(conflicts), WIDE_NONE, NO_CONFLICT)) - WIDE_NONE
    return [conflict_loss(conflict - every, wide=True) for conflict in conflicts]


def _pairs_beside(some: Poses, others: Poses) -> list[tuple[FragmentId, FragmentId]]:
    """Pairs of a fragment of the one and one of the other that are beside each other, each once."""
    one, other = sorted(some), sorted(others)
    places = [
        np.array([poses[id_][:2, 3] for id_ in ids])
        for poses, ids in ((some, one), (others, other))
    ]
    distances = np.linalg.norm(places[0][:, None] - places[1], axis=2)
    found = [(one[i], other[k]) for i, k in np.argwhere(distances < _BESIDE)]
    return [(a, b) for a, b in found if a < b or a not in others]


def _stages(one: FragmentId, other: FragmentId) -> tuple[int, int]:
    return min(one.stage, other.stage), max(one.stage, other.stage)
