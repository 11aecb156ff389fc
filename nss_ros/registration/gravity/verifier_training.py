"""Trains the verifier of the gravity method on hypotheses whose truth is known.

Only training reads ground truth; the verifier itself sees nothing but signs of the two fragments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.geometry import Transform, relative, rotation_angle
from nss_ros.registration.gravity.refinement import SIGNS, Candidate
from nss_ros.registration.gravity.verifier import Verifier

_TRANSLATION, _ROTATION = 0.2, np.radians(10)
_STEPS = 300
_LEARNING_RATE = 1e-2
_WEIGHT_DECAY = 0.5


@dataclass(frozen=True, slots=True)
class Case:
    """The hypotheses of a pair.

    Attributes:
        signs: (k, len(SIGNS)) float64.
        right: index of the hypothesis that is right; k when none is.
        same_stage: the fragments are of one stage.
        overlaps: they overlap.
    """

    signs: NDArray[np.float64]
    right: int
    same_stage: bool
    overlaps: bool


def case_of(candidates: tuple[Candidate, ...], truth: Transform | None, same_stage: bool) -> Case:
    """The case of aligned hypotheses; `truth` is None for fragments that do not overlap."""
    transforms = [each.refined.T_target_source for each in candidates]
    right = [n for n, each in enumerate(transforms) if truth is not None and is_right(each, truth)]
    signs = np.stack([each.signs for each in candidates])
    number = right[0] if right else len(candidates)
    return Case(signs, number, same_stage, truth is not None)


def is_right(estimate: Transform, truth: Transform) -> bool:
    """Whether an alignment is a success by the paper's limits, 10 degrees and 0.2 m."""
    difference = relative(estimate, truth)
    return bool(
        np.linalg.norm((estimate - truth)[:3, 3]) < _TRANSLATION
        and rotation_angle(difference) < _ROTATION
    )


def train_verifier(verifier: Verifier, cases: list[Case], seed: int = 0) -> float:
    """Trains the verifier in place; the mean loss at the end."""
    torch.manual_seed(seed)
    signs, right, same_stage, overlaps = stacked(cases)
    known = signs[~signs[..., 0].isnan()]
    verifier.mean.copy_(known.mean(dim=0))
    verifier.deviation.copy_(known.std(dim=0).clamp_min(1e-6))
    optimizer = torch.optim.AdamW(verifier.parameters(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
    for _ in range(_STEPS):
        optimizer.zero_grad()
        logs, overlap = verifier(signs, same_stage)
        loss = -logs.gather(1, right[:, None]).mean()
        loss = loss + torch.nn.functional.binary_cross_entropy_with_logits(overlap, overlaps)
        loss.backward()
        optimizer.step()
        schedule.step()
    return float(loss.detach())


def stacked(cases: list[Case]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Signs (b, k, s) with NaN for those there are not, right ones, kinds and overlaps (b,)."""
    most = max(len(case.signs) for case in cases)
    signs = np.full((len(cases), most, len(SIGNS)), np.nan)
    right = np.full(len(cases), most)
    for number, case in enumerate(cases):
        signs[number, : len(case.signs)] = case.signs
        if case.right < len(case.signs):
            right[number] = case.right
    return (
        torch.from_numpy(signs).float(),
        torch.from_numpy(right),
        torch.tensor([float(case.same_stage) for case in cases]),
        torch.tensor([float(case.overlaps) for case in cases]),
    )
