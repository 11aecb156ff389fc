"""Pairs for fragments that come while nobody says which of them to register.

A round takes the fragments that came since the last one, looks at them beside all others by
worker processes, and asks for the most promising pairs of each. Ground truth is never looked at.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from nss_ros.config import ProposalConfig, RegistrationConfig
from nss_ros.errors import RunError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.registration.gravity.proposals import Sketch, evidence_calls, proposed_pairs
from nss_ros.worker_process import stop_now, worker_pool


@dataclass(slots=True)
class _Round:
    """What is being computed for some fragments."""

    newcomers: list[FragmentId]
    sketches: list[Future[Sketch | None]] = field(default_factory=list)
    evidence: list[Future[dict[FragmentPair, float]]] = field(default_factory=list)


class Proposer:
    """Proposes pairs. Used by one thread; others may read `undecided`, then `proposed`.

    Args:
        proposals: when, and how many.
        registration: settings of the method `gravity`, whose maps are compared.
        workers: processes; 0: one per processor core.
    """

    def __init__(
        self, proposals: ProposalConfig, registration: RegistrationConfig, workers: int
    ) -> None:
        self.reconfigure(proposals, registration, workers)
        self._files: dict[FragmentId, Path] = {}
        self._undecided: set[FragmentId] = set()
        # What cannot be looked at has no sketch.
        self._sketches: dict[FragmentId, Sketch | None] = {}
        self._given: set[frozenset[FragmentId]] = set()
        self._expected = False
        self._proposed: set[frozenset[FragmentId]] = set()
        self._round: _Round | None = None
        self._pool: ProcessPoolExecutor | None = None

    @property
    def undecided(self) -> int:
        """Fragments that pairs will yet be proposed for."""
        return len(self._undecided) if self._wanted else 0

    @property
    def proposed(self) -> int:
        """Pairs proposed so far."""
        return len(self._proposed)

    def reconfigure(
        self, proposals: ProposalConfig, registration: RegistrationConfig, workers: int
    ) -> None:
        """Use other settings from the next round on."""
        self._proposals, self._registration = proposals, registration
        self._workers = workers or os.cpu_count() or 1

    def add_fragment(self, fragment: FragmentId, file: Path) -> None:
        """Note a fragment and the file that holds it, pickled."""
        self._files[fragment] = file
        self._undecided.add(fragment)

    def add_pair(self, pair: FragmentPair) -> None:
        """Note a pair that was asked for, by somebody else or by this one."""
        ends = frozenset((pair.source, pair.target))
        if ends not in self._proposed:
            self._given.add(ends)

    def expect_pairs(self) -> None:
        """Note that somebody else is about to ask for pairs."""
        self._expected = True

    def poll(self, quiet: float) -> list[FragmentPair]:
        """Go on with the round; pairs to ask for now.

        Args:
            quiet: seconds since the last fragment or pair came.

        Raises:
            RunError: a worker process died.
        """
        if not self._wanted:
            self.close()
            return []
        try:
            if self._round is None:
                if self._undecided and quiet >= self._proposals.quiet_time:
                    self._begin()
                return []
            return self._continue(self._round)
        except BrokenProcessPool as error:
            raise RunError(
                "A process that looks for pairs was killed or crashed: is there enough memory?"
            ) from error

    def close(self) -> None:
        """End the processes."""
        self._round = None
        if self._pool is not None:
            stop_now(self._pool)
            self._pool = None

    @property
    def _wanted(self) -> bool:
        when = self._proposals.when
        return when == "always" or (when == "auto" and not (self._expected or self._given))

    def _begin(self) -> None:
        self._pool = self._pool or worker_pool(self._workers)
        newcomers = sorted(self._undecided)
        self._round = _Round(newcomers)
        self._round.sketches = [
            self._pool.submit(_sketch, self._files[id_], self._registration) for id_ in newcomers
        ]

    def _continue(self, round_: _Round) -> list[FragmentPair]:
        if not all(map(Future.done, round_.sketches)) or not all(map(Future.done, round_.evidence)):
            return []
        if round_.sketches:
            made = (each.result() for each in round_.sketches)
            self._sketches |= dict(zip(round_.newcomers, made, strict=True))
            round_.sketches = []
            self._compare(round_)
            return []
        evidence = {
            pair: value for each in round_.evidence for pair, value in each.result().items()
        }
        chosen = self._chosen(round_.newcomers, evidence)
        # Last: who watches from another thread must not see a fragment decided and its pairs not
        # counted, and take the work for done.
        self._undecided -= set(round_.newcomers)
        self.close()
        return chosen

    def _compare(self, round_: _Round) -> None:
        """Begin to look at all pairs of the round's fragments."""
        assert self._pool is not None
        looked_at = [
            (first, second)
            for pair in self._candidates(round_.newcomers)
            if (first := self._sketches[pair.source]) and (second := self._sketches[pair.target])
        ]
        round_.evidence = [self._pool.submit(_evidence, call) for call in evidence_calls(looked_at)]

    def _chosen(
        self, newcomers: list[FragmentId], evidence: dict[FragmentPair, float]
    ) -> list[FragmentPair]:
        best = proposed_pairs(
            evidence, self._proposals.within, self._proposals.across, frozenset(newcomers)
        )
        # Nothing can be said about what has no sketch.
        blind = [
            pair
            for pair in self._candidates(newcomers)
            if self._sketches[pair.source] is None or self._sketches[pair.target] is None
        ]
        new = [
            pair
            for pair in sorted({*best, *blind})
            if frozenset((pair.source, pair.target)) not in self._given | self._proposed
        ]
        self._proposed |= {frozenset((pair.source, pair.target)) for pair in new}
        return new

    def _candidates(self, newcomers: list[FragmentId]) -> list[FragmentPair]:
        """Pairs of one area with a newcomer, those of earlier stages as sources."""
        new = set(newcomers)
        return [
            FragmentPair(min(one, other), max(one, other))
            for one in newcomers
            for other in sorted(self._sketches)
            if other.area == one.area and (other not in new or one < other)
        ]


# Only worker processes look at fragments: with torch, the node would start seconds later.
def _sketch(file: Path, config: RegistrationConfig) -> Sketch | None:
    from nss_ros.registration.gravity.evidence import sketch

    return sketch(pickle.loads(file.read_bytes()), config)


def _evidence(pairs: Sequence[tuple[Sketch, Sketch]]) -> dict[FragmentPair, float]:
    from nss_ros.registration.gravity.evidence import pair_evidence

    return pair_evidence(pairs)
