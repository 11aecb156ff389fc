"""Which pairs are worth registering, where nobody says it: those with the most evidence.

What is proposed grows with the number of fragments, not with that of pairs. How the evidence is
found is in `evidence`, which is for worker processes: torch takes seconds to import.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId, FragmentPair

#: Pairs that a worker looks at in one call, half a second.
PAIRS_PER_CALL = 64


@dataclass(frozen=True, slots=True)
class Sketch:
    """A fragment, reduced to what a quick look needs.

    Attributes:
        id: the fragment.
        maps: (2, CHANNELS, h, w) float16, coarse features for different stages and for one.
    """

    id: FragmentId
    maps: NDArray[np.float16]


def evidence_calls(
    pairs: Sequence[tuple[Sketch, Sketch]],
) -> list[Sequence[tuple[Sketch, Sketch]]]:
    """Pairs, those of a source together, divided into calls of `pair_evidence` for workers."""
    pairs = sorted(pairs, key=work_key)
    return [pairs[start : start + PAIRS_PER_CALL] for start in range(0, len(pairs), PAIRS_PER_CALL)]


def work_key(pair: tuple[Sketch, Sketch]) -> tuple[FragmentId, bool, int]:
    """Pairs of which this is the same share what is made of their source."""
    source, target = pair
    return source.id, source.id.stage == target.id.stage, target.maps.shape[-1]


def proposed_pairs(
    evidence: Mapping[FragmentPair, float],
    within: int,
    across: int,
    of: Container[FragmentId] | None = None,
) -> list[FragmentPair]:
    """For each fragment the pairs with the most evidence, in canonical order.

    Args:
        evidence: of pairs.
        within: pairs of each fragment with others of its stage.
        across: pairs of each fragment with others of other stages.
        of: the fragments that get pairs; None: all.
    """
    ranked = sorted(evidence, key=lambda pair: (-evidence[pair], pair))
    counts: dict[tuple[FragmentId, bool], int] = {}
    chosen = set()
    for pair in ranked:
        most = within if pair.same_stage else across
        for end in (pair.source, pair.target):
            key = (end, pair.same_stage)
            if (of is None or end in of) and counts.get(key, 0) < most:
                counts[key] = counts.get(key, 0) + 1
                chosen.add(pair)
    return sorted(chosen)
