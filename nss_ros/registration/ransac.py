"""RANSAC over matched keypoints, vectorised and reproducible.

Fischler and Bolles 1981, with the edge-length check of Open3D's and PCL's prerejective variants.
Open3D's own RANSAC runs one loop per thread against a shared stopping rule, so its answer may
depend on timing; here a seed gives one answer, whatever the machine's load or core count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform, from_yaw

_BATCH = 20_000
_SCORE_CHUNK = 256
_EDGE_SIMILARITY = 0.9
_NORMAL_COSINE = float(np.cos(np.radians(45.0)))
_DISTINCT_TRANSLATION = 0.5
_DISTINCT_ROTATION = float(np.radians(10.0))

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Matches:
    """Matched keypoints: source and target points and unit normals, each (m, 3) float64."""

    source: Array
    target: Array
    source_normals: Array
    target_normals: Array

    def __len__(self) -> int:
        return len(self.source)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A hypothesis: `T_target_source` and the number of matches that agree with it."""

    T_target_source: Transform
    inliers: int


def ransac(
    matches: Matches,
    distance: float,
    iterations: int,
    confidence: float,
    seed: int,
    level: bool = False,
    count: int = 1,
) -> list[Candidate]:
    """The transforms on which most matches agree.

    Args:
        matches: matched keypoints.
        distance: a match agrees when it ends closer than this, metres.
        iterations: most samples drawn.
        confidence: stop once a better transform would have been sampled with this probability.
        seed: of the samples.
        level: source and target are levelled; samples are then of two matches and determine yaw
            and translation only, else of three and determine all six degrees of freedom.
        count: most transforms returned.

    Returns:
        Up to `count` distinct transforms, most inliers first; empty when no sample is rigid.
    """
    size = 2 if level else 3
    if len(matches) < size:
        return []
    random = np.random.default_rng(seed)
    best: list[Candidate] = []
    drawn = 0
    needed = float(iterations)
    while drawn < needed:
        batch = int(min(_BATCH, iterations - drawn))
        if batch <= 0:
            break
        samples = random.integers(0, len(matches), size=(batch, size))
        drawn += batch
        rigid = rigid_samples(matches, samples, distance, level)
        transforms = _level_transforms(matches, rigid) if level else _transforms(matches, rigid)
        best = _merge(best, transforms, _count_inliers(matches, transforms, distance), count)
        if best:
            needed = _samples_needed(best[0].inliers / len(matches), size, confidence)
    return [_polish(candidate, matches, distance, level) for candidate in best]


def inlier_mask(matches: Matches, transform: Transform, distance: float) -> NDArray[np.bool_]:
    """Which matches agree with a transform in position and in normal, (m,)."""
    return np.asarray(_agreement(matches, transform[None], distance)[0])


def rigid_samples(
    matches: Matches, samples: NDArray[np.int64], distance: float, level: bool
) -> NDArray[np.int64]:
    """The samples whose edges are long enough and equally long in source and target."""
    rigid = np.ones(len(samples), dtype=bool)
    corners = samples.shape[1]
    for first in range(corners):
        for second in range(first + 1, corners):
            one, other = samples[:, first], samples[:, second]
            source = matches.source[one] - matches.source[other]
            target = matches.target[one] - matches.target[other]
            if level:
                rigid &= np.abs(source[:, 2] - target[:, 2]) < distance
                source, target = source[:, :2], target[:, :2]
            rigid &= _equally_long(source, target, 3 * distance)
    return samples[rigid]


def _equally_long(source: Array, target: Array, shortest: float) -> NDArray[np.bool_]:
    source_length = np.sqrt(np.einsum("ij,ij->i", source, source))
    target_length = np.sqrt(np.einsum("ij,ij->i", target, target))
    low = np.minimum(source_length, target_length)
    high = np.maximum(source_length, target_length)
    return np.asarray((low > shortest) & (low > _EDGE_SIMILARITY * high))


def _level_transforms(matches: Matches, samples: NDArray[np.int64]) -> Array:
    """Yaw and translation of samples of two matches, (s, 4, 4)."""
    one, other = samples[:, 0], samples[:, 1]
    source = matches.source[other] - matches.source[one]
    target = matches.target[other] - matches.target[one]
    yaw = np.arctan2(target[:, 1], target[:, 0]) - np.arctan2(source[:, 1], source[:, 0])
    rotations = np.zeros((len(samples), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
    rotations[:, 1, 0] = np.sin(yaw)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    rotations[:, 2, 2] = 1.0
    return _with_translations(matches, samples, rotations)


def _transforms(matches: Matches, samples: NDArray[np.int64]) -> Array:
    """Rigid transforms of samples of three matches, (s, 4, 4), by their triangles' axes."""
    source = _triangle_axes(matches.source[samples])
    target = _triangle_axes(matches.target[samples])
    rotations = np.einsum("sij,skj->sik", target, source)
    transforms = _with_translations(matches, samples, rotations)
    return transforms[np.isfinite(transforms).all(axis=(1, 2))]


def _triangle_axes(corners: Array) -> Array:
    """An orthonormal frame (s, 3, 3) of triangles (s, 3, 3); not finite where they are flat."""
    with np.errstate(invalid="ignore", divide="ignore"):
        first = corners[:, 1] - corners[:, 0]
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        third = np.cross(first, corners[:, 2] - corners[:, 0])
        third /= np.linalg.norm(third, axis=1, keepdims=True)
    return np.stack((first, np.cross(third, first), third), axis=2)


def _with_translations(matches: Matches, samples: NDArray[np.int64], rotations: Array) -> Array:
    source = matches.source[samples].mean(axis=1)
    target = matches.target[samples].mean(axis=1)
    transforms = np.zeros((len(samples), 4, 4))
    transforms[:, :3, :3] = rotations
    transforms[:, :3, 3] = target - np.einsum("sij,sj->si", rotations, source)
    transforms[:, 3, 3] = 1.0
    return transforms


def _count_inliers(matches: Matches, transforms: Array, distance: float) -> NDArray[np.int64]:
    counts = np.zeros(len(transforms), dtype=np.int64)
    for start in range(0, len(transforms), _SCORE_CHUNK):
        chunk = slice(start, start + _SCORE_CHUNK)
        counts[chunk] = _agreement(matches, transforms[chunk], distance).sum(axis=1)
    return counts


def _agreement(matches: Matches, transforms: Array, distance: float) -> NDArray[np.bool_]:
    """Which matches (m) agree with which transforms (s), (s, m).

    Written out per coordinate rather than as a matrix product, whose rounding depends on the BLAS
    library and its threads.
    """
    squared = np.zeros((len(transforms), len(matches)))
    cosine = np.zeros_like(squared)
    for row in range(3):
        moved = transforms[:, row, 3, None] - matches.target[:, row]
        turned = np.zeros_like(squared)
        for column in range(3):
            factor = transforms[:, row, column, None]
            moved += factor * matches.source[:, column]
            turned += factor * matches.source_normals[:, column]
        squared += moved * moved
        cosine += turned * matches.target_normals[:, row]
    return np.asarray((squared < distance**2) & (cosine > _NORMAL_COSINE))


def _merge(
    best: list[Candidate], transforms: Array, inliers: NDArray[np.int64], count: int
) -> list[Candidate]:
    """The best distinct candidates of the old ones and the new ones; the older wins a tie."""
    stack = np.concatenate([[c.T_target_source for c in best], transforms]) if best else transforms
    agreeing = np.concatenate(([c.inliers for c in best], inliers)).astype(np.int64)
    kept: list[Candidate] = []
    while len(kept) < count and len(stack):
        top = int(np.argmax(agreeing))
        kept.append(Candidate(stack[top], int(agreeing[top])))
        others = _distinct(stack, stack[top])
        stack, agreeing = stack[others], agreeing[others]
    return kept


def _distinct(transforms: Array, one: Transform) -> NDArray[np.bool_]:
    """Which transforms (s, 4, 4) differ from one by more than the noise of a sample, (s,)."""
    far = np.linalg.norm(transforms[:, :3, 3] - one[:3, 3], axis=1) > _DISTINCT_TRANSLATION
    trace = np.einsum("sij,ij->s", transforms[:, :3, :3], one[:3, :3])
    return np.asarray(far | ((trace - 1) / 2 < np.cos(_DISTINCT_ROTATION)))


def _samples_needed(ratio: float, size: int, confidence: float) -> float:
    """Samples until one of inliers only was drawn with the given probability."""
    success = ratio**size
    if success <= 0 or confidence >= 1:
        return float("inf")
    if success >= 1:
        return 0.0
    return float(np.log1p(-confidence) / np.log1p(-success))


def _polish(candidate: Candidate, matches: Matches, distance: float, level: bool) -> Candidate:
    """Least squares over the agreeing matches, kept when no fewer agree afterwards."""
    mask = inlier_mask(matches, candidate.T_target_source, distance)
    if mask.sum() < 3:
        return candidate
    transform = fit(matches.source[mask], matches.target[mask], level)
    inliers = int(inlier_mask(matches, transform, distance).sum())
    return Candidate(transform, inliers) if inliers >= candidate.inliers else candidate


def fit(source: Array, target: Array, level: bool = False) -> Transform:
    """Least-squares rigid transform of matched points (Umeyama 1991, without scale).

    Args:
        source: (m, 3), metres.
        target: (m, 3), metres.
        level: yaw and translation only.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    covariance = np.einsum("ij,ik->jk", target - target_mean, source - source_mean)
    if level:
        yaw = np.arctan2(covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1])
        transform = from_yaw(float(yaw), np.zeros(3))
    else:
        left, _, right = np.linalg.svd(covariance)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
        transform = np.eye(4)
        transform[:3, :3] = (left * sign) @ right
    transform[:3, 3] = target_mean - transform[:3, :3] @ source_mean
    return transform
