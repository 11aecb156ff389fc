"""A quick look at many pairs: how much speaks for their overlapping.

All poses are scored on coarse feature maps, of one source on many targets together, which takes a
hundredth of the time of a registration; the sum tells how likely two fragments overlap. Ground
truth is never looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

import numpy as np
import torch

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentPair
from nss_ros.registration.gravity.coarse import (
    POOL,
    fast_size,
    pooled,
    scores_of_many,
    turned_by_frequency,
)
from nss_ros.registration.gravity.method import feature_maps
from nss_ros.registration.gravity.proposals import Sketch, work_key
from nss_ros.registration.gravity.scan import fitting_scan_of
from nss_ros.registration.gravity.weights import load_weights
from nss_ros.registration.gravity.wide import evening
from nss_ros.standpoint import at_standpoint

# Targets whose scores are computed together.
_AT_ONCE = 8


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


def pair_evidence(pairs: Sequence[tuple[Sketch, Sketch]]) -> dict[FragmentPair, float]:
    """Logarithm of the evidence that the source and the target of each pair overlap.

    It can be compared among pairs of one stage, and among pairs of different stages. Pairs that
    follow each other share what was made of their source.
    """
    torch.set_num_threads(1)
    evidence: dict[FragmentPair, float] = {}
    with torch.inference_mode():
        for (id_, same_stage, _), together in groupby(pairs, key=work_key):
            some = list(together)
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


def _features(of: Sketch, kind: int) -> torch.Tensor:
    return torch.from_numpy(of.maps[kind].astype(np.float32))
