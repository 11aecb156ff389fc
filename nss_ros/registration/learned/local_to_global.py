"""Local-to-global registration (Qin et al., CVPR 2022, section 3.4).

Each pair of patches proposes the transform on which its own matches agree; the one on which most
matches of all patches agree is refined with those.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform, transform_points
from nss_ros.registration.ransac import Matches

Array = NDArray[np.float64]

_FEWEST_MATCHES = 3
_REFINEMENTS = 5
# Keeps the weights of no matches at all finite.
_LEAST_WEIGHT = 1e-5


@dataclass(frozen=True, slots=True)
class PatchMatches(Matches):
    """Matched points with the pair of patches in which they were matched.

    Attributes:
        scores: (m,) how sure each match is.
        patches: (m,) number of its pair of patches, ascending.
    """

    scores: Array
    patches: NDArray[np.int64]


def local_to_global(matches: PatchMatches, radius: float) -> Transform | None:
    """The transform on which most matches agree; None of fewer than three matches.

    Args:
        matches: of all pairs of patches.
        radius: a match agrees when it ends closer than this, metres.
    """
    if len(matches) < _FEWEST_MATCHES:
        return None
    agreeing = [_agreeing(matches, each, radius) for each in _proposals(matches)]
    best = max(agreeing, key=np.count_nonzero)
    for _ in range(_REFINEMENTS):
        transform = weighted_fit(matches.source, matches.target, matches.scores * best)
        best = _agreeing(matches, transform, radius)
    return transform


def _proposals(matches: PatchMatches) -> list[Transform]:
    """A transform of each pair of patches with enough matches; of all, if none has enough."""
    _, starts = np.unique(matches.patches, return_index=True)
    ends = np.append(starts[1:], len(matches))
    slices = [
        slice(start, end)
        for start, end in zip(starts, ends, strict=True)
        if end - start >= _FEWEST_MATCHES
    ] or [slice(None)]
    return [
        weighted_fit(matches.source[each], matches.target[each], matches.scores[each])
        for each in slices
    ]


def _agreeing(matches: PatchMatches, transform: Transform, radius: float) -> NDArray[np.bool_]:
    """Which matches agree with a transform in position, (m,)."""
    difference = transform_points(transform, matches.source) - matches.target
    return np.asarray(np.einsum("ij,ij->i", difference, difference) < radius**2)


def weighted_fit(source: Array, target: Array, weights: Array) -> Transform:
    """Weighted least-squares rigid transform of matched points (Arun et al. 1987), no reflection.

    Args:
        source: (m, 3), metres.
        target: (m, 3), metres.
        weights: (m,), not negative.
    """
    weights = weights / (weights.sum() + _LEAST_WEIGHT)
    source_mean, target_mean = weights @ source, weights @ target
    covariance = (weights[:, None] * (target - target_mean)).T @ (source - source_mean)
    left, _, right = np.linalg.svd(covariance)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    transform = np.eye(4)
    transform[:3, :3] = (left * sign) @ right
    transform[:3, 3] = target_mean - transform[:3, :3] @ source_mean
    return transform
