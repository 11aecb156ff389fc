"""Which pairs are worth registering, where nobody says it: a quick look at all pairs.

All poses are scored on coarse feature maps, of one source on many targets together, which takes a
hundredth of the time of a registration; the sum tells how likely two fragments overlap. What is
proposed grows with the number of fragments, not with that of pairs. Ground truth is never looked
at.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.registration.gravity.coarse import (
    POOL,
    fast_size,
    pooled,
    scores_of_many,
    turned_by_frequency,
)
from nss_ros.registration.gravity.method import feature_maps
from nss_ros.registration.gravity.scan import fitting_scan_of
from nss_ros.registration.gravity.weights import load_weights
from nss_ros.registration.gravity.wide import evening
from nss_ros.standpoint import at_standpoint

#: Pairs that a worker looks at in one call, half a second.
PAIRS_PER_CALL = 64
# Targets whose scores are computed together.
_AT_ONCE = 8


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
    scan = fitting_scan_of(at_standpoint(fragment, config.find_standpoints)[0], config)
    if len(scan.points) < config.min_points:
        return None
    network = load_weights(config.gravity.weights).network
    maps = torch.from_numpy(feature_maps(network, scan.maps))
    return Sketch(fragment.id, np.asarray(pooled(maps).numpy(), dtype=np.float16))


def evidence_calls(
    pairs: Sequence[tuple[Sketch, Sketch]],
) -> list[Sequence[tuple[Sketch, Sketch]]]:
    """Pairs, those of a source together, divided into calls of `pair_evidence` for workers."""
    pairs = sorted(pairs, key=_alike)
    return [pairs[start : start + PAIRS_PER_CALL] for start in range(0, len(pairs), PAIRS_PER_CALL)]


def pair_evidence(pairs: Sequence[tuple[Sketch, Sketch]]) -> dict[FragmentPair, float]:
    """Logarithm of the evidence that the source and the target of each pair overlap.

    It can be compared among pairs of one stage, and among pairs of different stages. Pairs that
    follow each other share what was made of their source.
    """
    torch.set_num_threads(1)
    evidence: dict[FragmentPair, float] = {}
    with torch.inference_mode():
        for (id_, same_stage, _), alike in groupby(pairs, key=_alike):
            some = list(alike)
            targets = [target for _, target in some]
            found = _evidence(some[0][0], targets, int(same_stage))
            evidence |= {
                FragmentPair(id_, target.id): each
                for target, each in zip(targets, found, strict=True)
            }
    return evidence


def _evidence(source: Sketch, targets: Sequence[Sketch], kind: int) -> list[float]:
    """The evidence of a source and each of some targets, whose maps are of one size."""
    moving = _features(source, kind)
    cells = targets[0].maps.shape[-1]
    size = fast_size(moving.shape[-1] + cells)
    factor = evening(moving.shape[-1] * POOL, cells * POOL)
    turned = turned_by_frequency(moving, size)
    found: list[float] = []
    for start in range(0, len(targets), _AT_ONCE):
        some = targets[start : start + _AT_ONCE]
        # Always as many at once: a product of matrices may depend on their size.
        stills = torch.zeros(_AT_ONCE, len(moving), cells, cells)
        for still, target in zip(stills, some, strict=False):
            still.copy_(_features(target, kind))
        scores = scores_of_many(turned, stills, size)[: len(some)].flatten(1) * factor
        found += (scores.logsumexp(dim=1) - math.log(scores.shape[1])).tolist()
    return found


def _alike(pair: tuple[Sketch, Sketch]) -> tuple[FragmentId, bool, int]:
    """Pairs of which this is the same share what is made of their source."""
    source, target = pair
    return source.id, source.id.stage == target.id.stage, target.maps.shape[-1]


def _features(of: Sketch, kind: int) -> torch.Tensor:
    return torch.from_numpy(of.maps[kind].astype(np.float32))


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
