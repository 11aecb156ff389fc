"""The best poses of scans that reach far, on maps wider than usual.

All poses of wide maps on fine cells would take seconds. The right yaw angle is nearly always among
those that look best on coarse cells, and of these all shifts are scored on fine ones.

Where bays repeat, the wide maps of the wrong bay score more the more they overlap. What both
scanners saw to be empty tells, so many poses are weighed by that before few are aligned.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.geometry import from_yaw
from nss_ros.registration.gravity.agreement import agreement
from nss_ros.registration.gravity.coarse import (
    COARSE_YAWS,
    coarse_scores,
    fast_size,
    pooled,
    shift_of_middles,
)
from nss_ros.registration.gravity.correlation import STEP, YAWS, correlate, rotated, spectrum
from nss_ros.registration.gravity.network import STRIDE, as_target
from nss_ros.registration.gravity.raster import SIZE
from nss_ros.registration.gravity.refinement import Shape
from nss_ros.registration.gravity.search import Peak, Search, best_places

# Poses on coarse cells whose yaw angles are looked at, and how many fine angles that may be.
_COARSE_POSES, _MOST_YAWS = 80, 24
# Poses that are weighed by what both scanners saw.
_POSES = 200
_EMPTY_WITHIN, _EMPTY_ACROSS = 150.0, 40.0
_USUAL = SIZE // STRIDE
_FINE = YAWS // COARSE_YAWS
_BATCH = 4


def is_wide(source: Tensor | NDArray[np.floating], target: Tensor | NDArray[np.floating]) -> bool:
    """Whether any of two features (c, n, n) is larger than usual."""
    return max(source.shape[-1], target.shape[-1]) > _USUAL


def evened(source: Tensor, target: Tensor, pool: int = 1) -> Tensor:
    """The source's features, scaled so that a pose scores about what it does on usual maps.

    A score is a sum over cells, and the verifier knows those of usual maps.

    Args:
        source: (c, n, n) float32.
        target: (c, m, m) float32.
        pool: how many cells along each side were made one.
    """
    return source * evening(source.shape[-1] * pool, target.shape[-1] * pool)


def evening(source: int, target: int) -> float:
    """The same as a factor, for features of so many cells along each side."""
    return min(_USUAL / min(source, target), 1.0) ** 2


def empty_weight(same_stage: bool) -> float:
    """What a share of wall points in space seen to be empty takes from the score of a pose.

    Within a stage hardly anything moves; between stages, walls are built where nothing was.
    """
    return _EMPTY_WITHIN if same_stage else _EMPTY_ACROSS


def wide_search(source: Tensor, target: Tensor) -> Search:
    """Many of the best poses of a source's features on a target's, of whatever sizes.

    Args:
        source: (c, n, n) float32, as a source.
        target: (c, m, m) float32, as a target.
    """
    with torch.inference_mode():
        numbers = _promising_yaws(source, target)
        size = fast_size(source.shape[-1] + target.shape[-1])
        spectra = spectrum(target, size)
        angles = torch.tensor(numbers) * (2 * math.pi / YAWS)
        # What is not looked at scores nothing; cyclic yaw angles are kept for the peaks.
        scores = torch.full((YAWS, size, size), -1e4)
        for part in torch.split(torch.arange(len(numbers)), _BATCH):
            chosen = [numbers[int(each)] for each in part]
            scores[chosen] = correlate(spectrum(rotated(source, angles[part]), size), spectra, size)
        places = best_places(scores, _POSES)
        total = float(scores.flatten().logsumexp(dim=0))
    sizes = source.shape[-1], target.shape[-1], size
    peaks = []
    for each in places:
        y, x = shift_of_middles(each.cells[1:], *sizes) * STEP
        yaw = float(each.cells[0]) * 2 * math.pi / YAWS
        peaks.append(Peak(yaw, float(x), float(y), each.score, each.mass - total))
    return Search(tuple(peaks), total - math.log(scores.numel()))


def weighed(found: Search, source: Shape, target: Shape, same_stage: bool, count: int) -> Search:
    """The `count` best poses of a wide search, by their scores and by what both scanners saw.

    Args:
        found: many poses.
        source: of the pair.
        target: of the pair.
        same_stage: both fragments are of one stage.
        count: most peaks.
    """
    z = target.floor.height - source.floor.height
    weight = empty_weight(same_stage)
    losses = np.array(
        [
            weight
            * agreement(source.view, target.view, from_yaw(peak.yaw, (peak.x, peak.y, z))).free
            for peak in found.peaks
        ]
    )
    masses = np.array([peak.mass for peak in found.peaks]) - losses
    left = float(np.logaddexp.reduce(masses))
    peaks = [
        replace(peak, score=peak.score - float(loss), mass=float(mass) - left)
        for peak, loss, mass in zip(found.peaks, losses, masses, strict=True)
    ]
    peaks.sort(key=lambda peak: -peak.score)
    return Search(tuple(peaks[:count]), found.evidence + left)


def _promising_yaws(source: Tensor, target: Tensor) -> list[int]:
    """Numbers of the fine yaw angles beside the poses that are best on coarse cells, ascending."""
    # `as_target` twice gives the features as a source again.
    places = best_places(coarse_scores(pooled(source), pooled(as_target(target))), _COARSE_POSES)
    chosen: set[int] = set()
    for place in places:
        middle = round(float(place.cells[0]) * _FINE)
        beside = {(middle + each) % YAWS for each in range(-_FINE + 1, _FINE)}
        if len(chosen | beside) <= _MOST_YAWS:
            chosen |= beside
    return sorted(chosen)
