"""Parts of a map, joined by evidence: from ambiguous pairs to the poses on which most agree.

A pair alone often cannot tell one bay of a building from the next; its right pose is then among
its alternatives. Every fragment begins as a part of its own, and the two parts that their pairs
link most surely are joined, again and again. How sure a link is, is Bayesian: a pair whose
hypothesis agrees with it speaks for it, a pair that is sure of something else against it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, inverse
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.spanning_tree import Closeness, Poses

# Poses of a pair that look alike in a building: what a hypothesis gains by agreeing with another.
# More would take the same bay, found by two pairs, for a proof.
_PLACES = 30.0
# No pair is surer than this, whatever it says.
_LEAST_DOUBT = 0.03
# But a person is.
_NO_DOUBT = 1e-30
# Logarithm of a doubt that only a person's constraint is below.
_GIVEN = math.log(_NO_DOUBT) / 2
# Logarithm of the odds below which a link is not even tried.
_LEAST_ODDS = -4.0
_MOST_HYPOTHESES = 6
_RIVALS = 5
# Hypotheses of each pair that are tried in triangles.
_MOST_IN_LOOPS = 3
_MOST_LOOPS = 12
# Hypotheses between two parts from which the best transform is chosen; all have a vote.
_MOST_CANDIDATES = 40
#: Fragments of a part that is large. Between two such parts many pairs are wrong alike where rooms
#: are: what they say together has a limit, logarithm of the odds.
LARGE = 3
_MOST_OF_LARGE = 8.0

Array = NDArray[np.float64]
#: What a transform from the frame of the second part to that of the first loses by what is seen
#: there, logarithm of the odds.
Loss = Callable[[Poses, Poses, Transform], float]


@dataclass(frozen=True, slots=True)
class Ambiguous:
    """A pair with its hypotheses.

    Attributes:
        source: fragment.
        target: fragment.
        transforms: (h, 4, 4), each `T_target_source`.
        inverses: (h, 4, 4), each `T_source_target`.
        probabilities: (h,), that each is right.
        doubt: probability that none is.
    """

    source: FragmentId
    target: FragmentId
    transforms: Array
    inverses: Array
    probabilities: Array
    doubt: float

    @classmethod
    def of(cls, m: Measurement) -> Ambiguous:
        """The hypotheses of a measurement."""
        listed = [(m.confidence, m.T_target_source)]
        listed += [(each.probability, each.T_target_source) for each in m.alternatives]
        listed = listed[:_MOST_HYPOTHESES]
        probabilities = np.array([p for p, _ in listed]).clip(1e-3, 1 - _LEAST_DOUBT)
        if m.manual:
            probabilities[0] = 1.0
        doubt = max(1 - float(probabilities.sum()), _NO_DOUBT if m.manual else _LEAST_DOUBT)
        transforms = np.array([t for _, t in listed])
        inverses = np.array([inverse(t) for t in transforms])
        return cls(m.pair.source, m.pair.target, transforms, inverses, probabilities, doubt)

    def towards(self, id_: FragmentId) -> Array:
        """Transforms (h, 4, 4) into the frame of one of the two fragments from the other's."""
        return self.transforms if id_ == self.target else self.inverses

    def other(self, id_: FragmentId) -> FragmentId:
        """The fragment that is not this one."""
        return self.source if id_ == self.target else self.target


def loop_gains(pairs: Sequence[Ambiguous], close: Closeness) -> list[Array]:
    """What the triangles that each hypothesis closes speak for it, (h,) per pair, logarithm.

    A pair that is sure of itself, and wrong, would else be followed before others that agree.
    """
    beside: dict[FragmentId, dict[FragmentId, Ambiguous]] = {}
    for pair in pairs:
        beside.setdefault(pair.source, {})[pair.target] = pair
        beside.setdefault(pair.target, {})[pair.source] = pair
    return [_loop_gain(pair, beside, close) for pair in pairs]


def _loop_gain(
    pair: Ambiguous, beside: dict[FragmentId, dict[FragmentId, Ambiguous]], close: Closeness
) -> Array:
    gains = np.zeros(len(pair.probabilities))
    known, across = beside[pair.source], beside[pair.target]
    thirds = sorted(
        known.keys() & across.keys(),
        key=lambda third: (-known[third].probabilities[0] * across[third].probabilities[0], third),
    )
    paths: list[Array] = []
    sizes: list[float] = []
    counts: list[int] = []
    for third in thirds[:_MOST_LOOPS]:
        first, second = known[third], across[third]
        way = (
            second.towards(pair.target)[:_MOST_IN_LOOPS, None]
            @ first.towards(third)[None, :_MOST_IN_LOOPS]
        )
        likely = np.outer(
            second.probabilities[:_MOST_IN_LOOPS], first.probabilities[:_MOST_IN_LOOPS]
        )
        paths.append(way.reshape(-1, 4, 4))
        sizes.extend(np.log(np.maximum(likely * _PLACES, 1)).ravel())
        counts.append(likely.size)
    if not paths:
        return gains
    stack = np.concatenate(paths)
    starts = np.cumsum([0, *counts[:-1]])
    for number, transform in enumerate(pair.transforms[:_MOST_IN_LOOPS]):
        closing = np.where(close.agree(transform, stack), sizes, 0.0)
        gains[number] = np.maximum.reduceat(closing, starts).sum()
    return gains


@dataclass(frozen=True, slots=True)
class _Link:
    """The best transform between two parts.

    Attributes:
        odds: logarithm of the odds that it is right.
        transform: from the frame of the second part to that of the first.
        seen: what is seen there has been taken from the odds.
    """

    odds: float
    transform: Transform
    seen: bool = False


def joined_parts(
    fragments: Iterable[FragmentId],
    measurements: Sequence[Measurement],
    close: Closeness,
    least_odds: float = _LEAST_ODDS,
    known: Sequence[Poses] = (),
    loss: Loss | None = None,
) -> list[Poses]:
    """Parts of the map, largest first, each with poses in a frame of its own.

    The surest links are followed first, the doubtful ones last: they are to be judged when all is
    in place.

    Args:
        fragments: all of them.
        measurements: between them, with their alternatives.
        close: when two poses of a fragment agree.
        least_odds: logarithm of the odds of a link that is followed.
        known: parts that are joined already; what lies within them says nothing.
        loss: of a link, looked at before it is followed.
    """
    joining = _Joining(fragments, [Ambiguous.of(m) for m in measurements], close, known)
    while (best := joining.best()) is not None and best[0] > least_odds:
        if loss is None or joining.stands(*best, loss):
            joining.join(*best[1:])
    return sorted(joining.parts.values(), key=lambda part: (-len(part), min(part)))


class _Joining:
    """Parts that are being joined, and the links between them."""

    def __init__(
        self,
        fragments: Iterable[FragmentId],
        pairs: list[Ambiguous],
        close: Closeness,
        known: Sequence[Poses],
    ) -> None:
        alone = set(fragments).difference(*known)
        parts = [dict(part) for part in known] + [{id_: np.eye(4)} for id_ in sorted(alone)]
        self.parts: dict[int, Poses] = dict(enumerate(parts))
        self._close = close
        self._next = len(parts)
        number = {id_: n for n, part in self.parts.items() for id_ in part}
        pairs = [pair for pair in pairs if number[pair.source] != number[pair.target]]
        self._pairs: dict[int, dict[int, list[Ambiguous]]] = {n: {} for n in self.parts}
        for pair in pairs:
            one, other = number[pair.target], number[pair.source]
            self._pairs[one].setdefault(other, []).append(pair)
            self._pairs[other].setdefault(one, []).append(pair)
        self._links: dict[tuple[int, int], _Link] = {}
        self._queue: list[tuple[float, int, int]] = []
        gains = {
            tuple(sorted((number[pair.source], number[pair.target]))): gain
            for pair, gain in zip(pairs, loop_gains(pairs, close), strict=True)
        }
        for (one, other), gain in gains.items():
            self._measure(one, other, gain)

    def best(self) -> tuple[float, int, int] | None:
        """The odds of the surest link, and the parts that it links."""
        while self._queue:
            odds, one, other = self._queue[0]
            if one in self.parts and other in self.parts:
                return -odds, one, other
            heappop(self._queue)
        return None

    def stands(self, odds: float, one: int, other: int, loss: Loss) -> bool:
        """Whether the surest link loses nothing by what is seen; else it waits for its turn."""
        link = self._links[one, other]
        if link.seen:
            return True
        taken = loss(self.parts[one], self.parts[other], link.transform)
        self._links[one, other] = replace(link, odds=odds - taken, seen=True)
        if taken <= 0:
            return True
        heappop(self._queue)
        heappush(self._queue, (taken - odds, one, other))
        return False

    def join(self, one: int, other: int) -> None:
        """Make one part of two."""
        link = self._links[one, other]
        part = self.parts.pop(one)
        for id_, pose in self.parts.pop(other).items():
            part[id_] = link.transform @ pose
        new, self._next = self._next, self._next + 1
        self.parts[new] = part
        pairs: dict[int, list[Ambiguous]] = {}
        for old in (one, other):
            for third, between in self._pairs.pop(old).items():
                if third not in (one, other):
                    pairs.setdefault(third, []).extend(between)
                    del self._pairs[third][old]
        self._pairs[new] = pairs
        for third, between in pairs.items():
            self._pairs[third][new] = between
            self._measure(third, new)

    def _measure(self, one: int, other: int, gains: Array | None = None) -> None:
        pairs = self._pairs[one][other]
        link = _link(self.parts[one], self.parts[other], pairs, self._close, gains)
        self._links[one, other] = link
        heappush(self._queue, (-link.odds, one, other))


def _link(
    one: Poses,
    other: Poses,
    pairs: Sequence[Ambiguous],
    close: Closeness,
    gains_of_loops: Array | None = None,
) -> _Link:
    """The best transform from the frame of `other` to that of `one`.

    Args:
        one: a part.
        other: another.
        pairs: between them.
        close: when two poses agree.
        gains_of_loops: of the hypotheses of the only pair of two fragments; None: not counted.
    """
    votes = Votes.of(one, other, pairs)
    candidates = votes.likeliest(_MOST_CANDIDATES)
    agree = votes.agreement(votes.transforms[candidates], close)
    scores = votes.scores(agree) - math.log(_PLACES)
    if gains_of_loops is not None and len(pairs) == 1:
        scores = scores + gains_of_loops[candidates]
    best = int(np.argmax(scores))
    odds = _odds(scores, agree[:, candidates], best, float(votes.doubts.sum()))
    if min(len(one), len(other)) >= LARGE and not votes.given.size:
        odds = min(odds, _MOST_OF_LARGE)
    return _Link(
        odds,
        _mean(votes.transforms[agree[best]], np.exp(votes.weights[agree[best]])),
    )


@dataclass(frozen=True, slots=True)
class Votes:
    """Hypotheses of the pairs between two parts, and what they say of transforms between these.

    Attributes:
        transforms: (h, 4, 4) from the frame of the other part to that of the one.
        poses: (h, 4, 4) of the fragment of the other part, in the frame of the one.
        own: (h, 4, 4) of the same fragment, in the other part.
        weights: (h,) logarithm of what a transform gains that agrees.
        doubts: (p,) logarithm of the probability that no hypothesis of a pair is right.
        starts: (p,) where the hypotheses of each pair begin.
    """

    transforms: Array
    poses: Array
    own: Array
    weights: Array
    doubts: Array
    starts: NDArray[np.intp]

    @classmethod
    def of(cls, one: Poses, other: Poses, pairs: Sequence[Ambiguous]) -> Votes:
        """The votes of pairs, one or more, each with a fragment in each part."""
        placed: list[Array] = []
        ends: list[Transform] = []
        for pair in pairs:
            here = pair.target if pair.target in one else pair.source
            placed.append(one[here] @ pair.towards(here))
            ends.append(other[pair.other(here)])
        counts = [len(each) for each in placed]
        poses, own = np.concatenate(placed), np.repeat(np.array(ends), counts, axis=0)
        backward = np.array([inverse(end) for end in ends])
        return cls(
            poses @ np.repeat(backward, counts, axis=0),
            poses,
            own,
            np.log(np.concatenate([pair.probabilities for pair in pairs]) * _PLACES),
            np.log([pair.doubt for pair in pairs]),
            np.cumsum([0, *counts[:-1]]),
        )

    def likeliest(self, count: int) -> NDArray[np.intp]:
        """Numbers of the most probable hypotheses."""
        return np.argsort(-self.weights, kind="stable")[:count]

    def agreement(self, candidates: Array, close: Closeness) -> NDArray[np.bool_]:
        """Which candidates (k, 4, 4) put the fragments of which hypotheses where these do, (k, h).

        Args:
            candidates: from the frame of the other part to that of the one.
            close: when they agree.
        """
        moved = np.einsum("kij,hj->khi", candidates[:, :3, :3], self.own[:, :3, 3])
        moved += candidates[:, None, :3, 3]
        near = ((moved - self.poses[None, :, :3, 3]) ** 2).sum(axis=2) < close.translation**2
        turns = candidates[:, :3, :3].reshape(-1, 9), self.transforms[:, :3, :3].reshape(-1, 9)
        cosine = (np.einsum("ik,jk->ij", *turns) - 1) / 2
        return np.asarray(near & (cosine > math.cos(close.rotation)))

    def scores(self, agree: NDArray[np.bool_]) -> Array:
        """Logarithm of the evidence for transforms, (k,), by whom they agree with, (k, h)."""
        gains = np.maximum.reduceat(np.where(agree, self.weights, -np.inf), self.starts, axis=1)
        return np.asarray(np.where(np.isfinite(gains), gains, self.doubts).sum(axis=1))

    def obeyed(self, agree: NDArray[np.bool_]) -> NDArray[np.intp]:
        """With how many constraints of a person transforms agree, (k,).

        Args:
            agree: (k, h), with which hypotheses.
        """
        return np.asarray(agree[:, self.given].sum(axis=1))

    @property
    def given(self) -> NDArray[np.intp]:
        """Numbers of the hypotheses that a person gave."""
        return self.starts[self.doubts < _GIVEN]


def _odds(scores: Array, agree: NDArray[np.bool_], best: int, elsewhere: float) -> float:
    """Logarithm of the odds of the best transform against all others, and against none."""
    rivals = [elsewhere]
    left = ~(agree[best] | agree[:, best])
    while left.any() and len(rivals) < _RIVALS:
        rival = int(np.argmax(np.where(left, scores, -np.inf)))
        rivals.append(float(scores[rival]))
        left &= ~(agree[rival] | agree[:, rival])
    return float(scores[best] - np.logaddexp.reduce(rivals))


def _mean(transforms: Array, weights: Array) -> Transform:
    """The weighted mean of transforms (n, 4, 4) that are near each other."""
    weights = weights / weights.sum()
    mean = np.eye(4)
    left, _, right = np.linalg.svd(np.einsum("n,nij->ij", weights, transforms[:, :3, :3]))
    mean[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    mean[:3, 3] = np.einsum("n,nj->j", weights, transforms[:, :3, 3])
    return mean
