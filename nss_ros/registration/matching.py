"""Mutual nearest neighbours of descriptors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

# Descriptors are integers (see `features`) with squared norms below 2**24 / 2, so that every
# product and sum of the distance is exact in float32: the matches are the same whatever BLAS
# library, thread count or block size computes them.
_CHUNK = 1024


def mutual_matches(
    source: NDArray[np.float32], target: NDArray[np.float32]
) -> tuple[Indices, Indices]:
    """Pairs of descriptors that are each other's nearest.

    Args:
        source: (n, d) float32, integer values.
        target: (m, d) float32, integer values.

    Returns:
        Indices into source and into target, each (k,), ordered by source. Of equally near
        neighbours the first counts.
    """
    if len(source) == 0 or len(target) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    half_norms = np.einsum("ij,ij->i", target, target) / np.float32(2)
    source_norms = np.einsum("ij,ij->i", source, source) / np.float32(2)
    forward = np.empty(len(source), dtype=np.int64)
    backward = np.zeros(len(target), dtype=np.int64)
    nearest = np.full(len(target), np.inf, dtype=np.float32)
    for start in range(0, len(source), _CHUNK):
        rows = slice(start, start + _CHUNK)
        distances = half_norms - source[rows] @ target.T
        forward[rows] = distances.argmin(axis=1)
        distances += source_norms[rows, None]
        chunk_best = distances.argmin(axis=0)
        chunk_nearest = distances[chunk_best, np.arange(len(target))]
        closer = chunk_nearest < nearest
        nearest[closer] = chunk_nearest[closer]
        backward[closer] = chunk_best[closer] + start
    mutual = np.flatnonzero(backward[forward] == np.arange(len(source)))
    return mutual, forward[mutual]
