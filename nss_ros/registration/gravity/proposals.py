"""Which pairs are worth registering, where nobody says it: a quick look at all pairs.

The score of all poses on coarse feature maps takes a tenth of the time of the search, and its sum
tells how likely two fragments overlap. What is proposed grows with the number of fragments, not
with that of pairs. Ground truth is never looked at.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.registration.gravity.coarse import POOL, coarse_scores, pooled
from nss_ros.registration.gravity.method import feature_maps
from nss_ros.registration.gravity.scan import fitting_scan_of
from nss_ros.registration.gravity.weights import load_weights
from nss_ros.registration.gravity.wide import evened
from nss_ros.standpoint import at_standpoint

#: Pairs that a worker looks at in one call, a few seconds.
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


def sketch(fragment: Fragment, config: RegistrationConfig) -> Sketch | None:
    """A fragment's sketch; None if it is not levelled or has too few points."""
    if not fragment.gravity_aligned:
        return None
    scan = fitting_scan_of(at_standpoint(fragment)[0], config)
    if len(scan.points) < config.min_points:
        return None
    network = load_weights(config.gravity.weights).network
    maps = torch.from_numpy(feature_maps(network, scan.maps))
    return Sketch(fragment.id, np.asarray(pooled(maps).numpy(), dtype=np.float16))


def overlap_evidence(source: Sketch, target: Sketch) -> float:
    """Logarithm of the evidence that two fragments of one area overlap.

    It can be compared among pairs of one stage, and among pairs of different stages.
    """
    kind = int(FragmentPair(source.id, target.id).same_stage)
    with torch.inference_mode():
        moving, still = (
            torch.from_numpy(each.maps[kind].astype(np.float32)) for each in (source, target)
        )
        scores = coarse_scores(evened(moving, still, POOL), still).flatten()
        return float(scores.logsumexp(dim=0)) - math.log(len(scores))


def evidence_calls(
    pairs: Sequence[tuple[Sketch, Sketch]],
) -> list[Sequence[tuple[Sketch, Sketch]]]:
    """Pairs, divided into calls of `pair_evidence` for worker processes."""
    return [pairs[start : start + PAIRS_PER_CALL] for start in range(0, len(pairs), PAIRS_PER_CALL)]


def pair_evidence(pairs: Sequence[tuple[Sketch, Sketch]]) -> dict[FragmentPair, float]:
    """The evidence of pairs, each a source and a target."""
    torch.set_num_threads(1)
    return {
        FragmentPair(source.id, target.id): overlap_evidence(source, target)
        for source, target in pairs
    }


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
