"""A bag with pairs, from one whose pairs nobody chose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from nss_ros.bag import read_log, with_source_points, write_bag
from nss_ros.config import RegistrationConfig
from nss_ros.errors import BagError, InputError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.parallel import run
from nss_ros.registration.gravity.evidence import pair_evidence, sketch
from nss_ros.registration.gravity.proposals import (
    PAIRS_PER_CALL,
    Sketch,
    evidence_calls,
    proposed_pairs,
)


@dataclass(frozen=True, slots=True)
class Proposal:
    """What was proposed.

    Attributes:
        pairs: all of the new bag, in canonical order.
        given: how many of them the old bag asked for and were kept.
        possible: pairs of fragments of one area.
        unfit: fragments that cannot be looked at: not levelled, too few points, far reach.
    """

    pairs: tuple[FragmentPair, ...]
    given: int
    possible: int
    unfit: tuple[FragmentId, ...]


def propose(
    bag: Path,
    output: Path,
    within: int,
    across: int,
    config: RegistrationConfig,
    anew: bool = False,
    workers: int = 0,
    report: Callable[[str, int, int], None] = lambda *_: None,
) -> Proposal:
    """Write a copy of a bag that asks for the pairs that look most like overlapping.

    Args:
        bag: with fragments. Its ground truth is copied and not looked at.
        output: folder of the new bag.
        within: pairs of each fragment with others of its stage.
        across: pairs of each fragment with others of other stages.
        config: of the method `gravity`.
        anew: the pairs that the bag asks for are forgotten; else they stay.
        workers: processes; 0: one per core.
        report: called with what is done, how many are done, and how many there are.

    Raises:
        BagError: the bag cannot be read, or the output exists or cannot be written.
        InputError: the bag holds no fragments, or none that can be looked at.
    """
    if output.exists():
        raise BagError(f"{output} exists already: choose another name or remove it.")
    log = with_source_points(read_log(bag))
    if not log.fragments:
        raise InputError(f"{bag} holds no fragments, so there are no pairs to propose.")
    sketches = _sketches(list(log.fragments.values()), config, workers, report)
    known = {each.id for each in sketches}
    unfit = tuple(id_ for id_ in sorted(log.fragments) if id_ not in known)
    if len(sketches) < 2:
        raise InputError(
            f"{bag} holds fewer than two levelled fragments with {config.min_points} points, and "
            "only these can be looked at quickly: choose its pairs yourself."
        )
    evidence = _evidence(sketches, workers, report)
    found = proposed_pairs(evidence, within, across)
    kept = () if anew else log.pairs
    given = {frozenset((pair.source, pair.target)) for pair in kept}
    new = [pair for pair in found if frozenset((pair.source, pair.target)) not in given]
    pairs = (*kept, *new)
    write_bag(output, log.fragments.values(), pairs, log.ground_truth, log.metadata)
    return Proposal(tuple(sorted(pairs)), len(kept), len(evidence), unfit)


def _sketches(
    fragments: Sequence[Fragment],
    config: RegistrationConfig,
    workers: int,
    report: Callable[[str, int, int], None],
) -> list[Sketch]:
    found = []
    calls = [(fragment, config) for fragment in fragments]
    for number, each in enumerate(run(_sketch, calls, workers), 1):
        report("fragments", number, len(fragments))
        if each is not None:
            found.append(each)
    return sorted(found, key=lambda each: each.id)


def _sketch(call: tuple[Fragment, RegistrationConfig]) -> Sketch | None:
    return sketch(*call)


def _evidence(
    sketches: Sequence[Sketch], workers: int, report: Callable[[str, int, int], None]
) -> dict[FragmentPair, float]:
    pairs = [(a, b) for a, b in combinations(sketches, 2) if a.id.area == b.id.area]
    calls = evidence_calls(pairs)
    evidence: dict[FragmentPair, float] = {}
    for number, each in enumerate(run(pair_evidence, calls, workers), 1):
        report("pairs", min(number * PAIRS_PER_CALL, len(pairs)), len(pairs))
        evidence |= each
    return evidence
