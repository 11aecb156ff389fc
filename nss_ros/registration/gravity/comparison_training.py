"""Trains the second look of the gravity method on aligned hypotheses whose truth is known.

Among the hypotheses of a pair that are hardest to tell, and "none of them", the right one is to get
the largest probability. Only training reads ground truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.geometry import inverse
from nss_ros.registration.gravity.comparison import Comparison, compared
from nss_ros.registration.gravity.correlation import planar, rotated
from nss_ros.registration.gravity.network import as_target
from nss_ros.registration.gravity.refinement import COMPARISON_SIGNS
from nss_ros.registration.gravity.verifier import Verifier, judge
from nss_ros.registration.gravity.verifier_training import Case, train_verifier

_TURN = 2 * math.pi
# Hypotheses of a pair that are looked at.
_MOST = 6
_BATCH = 8
_LEARNING_RATE, _WEIGHT_DECAY = 1.5e-3, 0.02
# Shares of the trials whose grid stays as it is, and is turned by quarters; the rest is turned by
# any angle.
_STILL, _QUARTERS = 0.4, 0.3
_SCALE_CASES = 200


@dataclass(frozen=True, slots=True)
class _Trial:
    """A case, and those of its hypotheses that are hardest to tell.

    Attributes:
        case: of a pair with usual maps.
        chosen: numbers of hypotheses.
        right: which of the chosen ones is right; their number if none is.
    """

    case: Case
    chosen: list[int]
    right: int


def train_comparison(
    comparison: Comparison, cases: Sequence[Case], steps: int, seed: int
) -> Iterator[tuple[int, float]]:
    """Trains the second look in place, on the pairs with usual maps; yields step and loss."""
    usual = [case for case in cases if case.is_usual]
    if not usual:
        return
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    trials = _trials(cases, usual, seed)
    _set_scales(comparison, usual[:_SCALE_CASES])
    none = torch.nn.Parameter(torch.zeros(()))
    optimizer = torch.optim.AdamW(
        [*comparison.parameters(), none], _LEARNING_RATE, weight_decay=_WEIGHT_DECAY
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, steps, pct_start=0.1)
    waiting: list[int] = []
    for step in range(steps):
        losses = []
        for _ in range(_BATCH):
            waiting = waiting or rng.permutation(len(trials)).tolist()
            trial = trials[waiting.pop()]
            odds = comparison(*_augmented(trial, rng))
            logs = torch.cat((odds, none[None])).log_softmax(dim=0)
            losses.append(-logs[trial.right])
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(comparison.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        yield step, float(loss.detach())


def with_looks(cases: Sequence[Case], comparison: Comparison) -> list[Case]:
    """The cases with the signs of a second look."""
    return [
        replace(case, signs=_with_look(case, comparison)) if case.is_usual else case
        for case in cases
    ]


def _with_look(case: Case, comparison: Comparison) -> NDArray[np.float64]:
    source, target = (torch.from_numpy(each).float() for each in case.maps)
    look = compared(comparison, source, target, *planar(case.transforms)).double().numpy()
    signs = case.signs.copy()
    signs[:, COMPARISON_SIGNS] = np.stack((look, look - look.max()), axis=1)
    return signs


def _without_look(case: Case) -> NDArray[np.float64]:
    signs = case.signs.copy()
    signs[:, COMPARISON_SIGNS] = 0
    return signs


def _trials(cases: Sequence[Case], usual: Sequence[Case], seed: int) -> list[_Trial]:
    """What a verifier without second looks finds hard."""
    verifier = Verifier()
    train_verifier(verifier, [replace(case, signs=_without_look(case)) for case in cases], seed)
    trials = []
    for case in usual:
        signs = list(_without_look(case))
        probabilities = judge(verifier, signs, case.same_stage).probabilities
        chosen = np.argsort(-probabilities, kind="stable")[:_MOST].tolist()
        if case.right < len(case.signs) and case.right not in chosen:
            chosen[-1] = case.right
        right = chosen.index(case.right) if case.right in chosen else len(chosen)
        trials.append(_Trial(case, chosen, right))
    return trials


def _augmented(trial: _Trial, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Features of source and target on the target's grid, which is turned at random."""
    transforms = trial.case.transforms[trial.chosen]
    source, target = (torch.from_numpy(each).float() for each in trial.case.maps)
    if rng.random() < 0.5:
        source, target = target, source
        transforms = np.array([inverse(each) for each in transforms])
    kind = rng.random()
    angle = 0.0
    if kind > _STILL + _QUARTERS:
        angle = rng.random() * _TURN
    elif kind > _STILL:
        angle = float(rng.integers(1, 4)) * _TURN / 4
    if angle:
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        transforms = turn @ transforms
        target = rotated(target, torch.tensor([angle], dtype=torch.float32))[0]
    return rotated(source, *planar(transforms)), as_target(target)


def _set_scales(comparison: Comparison, cases: Sequence[Case]) -> None:
    features, products = [], []
    for case in cases:
        source, target = (torch.from_numpy(each).float() for each in case.maps)
        moved = rotated(source, *planar(case.transforms[:1]))[0]
        features.append(target.square().mean(dim=(1, 2)))
        products.append((moved * as_target(target)).square().mean(dim=(1, 2)))
    for scale, squares in (
        (comparison.feature_scale, features),
        (comparison.product_scale, products),
    ):
        scale.copy_(torch.stack(squares).mean(dim=0).sqrt().clamp_min(1e-3)[:, None, None])
