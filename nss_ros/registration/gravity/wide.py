"""The best poses of maps that are wider than usual: coarsely of all yaw angles, finely of the best.

All poses of wide maps on fine cells would take seconds. The right yaw angle is nearly always among
those that look best on coarse cells, and of these all shifts are scored on fine ones.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nss_ros.registration.gravity.coarse import (
    COARSE_YAWS,
    coarse_scores,
    fast_size,
    pooled,
    shift_of_middles,
)
from nss_ros.registration.gravity.correlation import STEP, YAWS, correlate, rotated, spectrum
from nss_ros.registration.gravity.network import as_target
from nss_ros.registration.gravity.search import Peak, Search, best_places

# Poses on coarse cells whose yaw angles are looked at, and how many fine angles that may be.
_COARSE_POSES, _MOST_YAWS = 40, 24
_FINE = YAWS // COARSE_YAWS
_BATCH = 4


def wide_search(source: Tensor, target: Tensor, count: int) -> Search:
    """The `count` best poses of a source's features on a target's, of whatever sizes.

    Args:
        source: (c, n, n) float32, as a source.
        target: (c, m, m) float32, as a target.
        count: most peaks.
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
        places = best_places(scores, count)
        total = float(scores.flatten().logsumexp(dim=0))
    sizes = source.shape[-1], target.shape[-1], size
    peaks = []
    for each in places:
        y, x = shift_of_middles(each.cells[1:], *sizes) * STEP
        yaw = float(each.cells[0]) * 2 * math.pi / YAWS
        peaks.append(Peak(yaw, float(x), float(y), each.score, each.mass - total))
    return Search(tuple(peaks), total - math.log(scores.numel()))


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

