"""Trains the second look of the gravity method on poses of the search whose truth is known.

Among the right pose of a pair, some that are hard to tell from it, and "none of them", the right
one is to get the largest probability. Poses need not be aligned for that, so that many pairs can be
shown. Only training reads ground truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.geometry import Transform
from nss_ros.registration.gravity.comparison import Comparison, swapped
from nss_ros.registration.gravity.correlation import rotated
from nss_ros.registration.gravity.network import as_target
from nss_ros.registration.gravity.search import Peak

#: Poses of a pair that are kept.
POSES = 64
_TURN = 2 * math.pi
# A pose of the grid that is this near the truth is right; one that is near, but not as near, is
# neither right nor wrong.
_RIGHT_TRANSLATION, _RIGHT_ROTATION = 0.2, math.radians(4)
_NEAR_TRANSLATION, _NEAR_ROTATION = 0.45, math.radians(10)
# Wrong poses beside the right one: the better their score, the more often, and any now and then.
_WRONG, _SOFTNESS, _ANY = 5, 4.0, 0.05
_FIRST_RIGHT = 0.8
_BATCH = 8
_LEARNING_RATE, _WEIGHT_DECAY = 1.5e-3, 0.02
# Shares of the trials whose grid stays as it is, and is turned by quarters; the rest is turned by
# any angle.
_STILL, _QUARTERS = 0.4, 0.3
_SCALE_PAIRS = 200


@dataclass(frozen=True, slots=True)
class PosedPair:
    """Poses of the search of a pair.

    Attributes:
        maps: (CHANNELS, n, n) float16 each, features of source and target, both as a source.
        poses: (k, 4), yaw of `T_target_source` in radians, its x and y in metres, and the score.
        right: (k,) which are right.
        wrong: (k,) which are not even near.
    """

    maps: tuple[NDArray[np.float16], NDArray[np.float16]]
    poses: NDArray[np.float32]
    right: NDArray[np.bool_]
    wrong: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        maps: tuple[NDArray[np.float16], NDArray[np.float16]],
        peaks: Sequence[Peak],
        truth: Transform | None,
    ) -> PosedPair:
        """The pair with its ground truth `T_target_source`; None if the fragments are apart."""
        poses = np.array([(p.yaw, p.x, p.y, p.score) for p in peaks], dtype=np.float32)
        right, near = np.zeros((2, len(poses)), dtype=bool)
        if truth is not None:
            away = np.hypot(*(poses[:, 1:3] - truth[:2, 3]).T)
            difference = poses[:, 0] - np.arctan2(truth[1, 0], truth[0, 0])
            turned = np.abs((difference + math.pi) % _TURN - math.pi)
            right = (away < _RIGHT_TRANSLATION) & (turned < _RIGHT_ROTATION)
            near = (away < _NEAR_TRANSLATION) & (turned < _NEAR_ROTATION)
        return cls(maps, poses, right, ~near)

    @property
    def is_clear(self) -> bool:
        """Some pose is right, or none is even near."""
        return bool(self.right.any() or self.wrong.all())


def train_comparison(
    comparison: Comparison, pairs: Sequence[PosedPair], steps: int, seed: int
) -> Iterator[tuple[int, float]]:
    """Trains the second look in place; yields step and loss. Without pairs it stays as it is."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    clear = [pair for pair in pairs if pair.is_clear]
    if not clear:
        return
    _set_scales(comparison, clear[:_SCALE_PAIRS])
    none = torch.nn.Parameter(torch.zeros(()))
    optimizer = torch.optim.AdamW(
        [*comparison.parameters(), none], _LEARNING_RATE, weight_decay=_WEIGHT_DECAY
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, steps, pct_start=0.1)
    waiting: list[int] = []
    for step in range(steps):
        losses = []
        for _ in range(_BATCH):
            waiting = waiting or rng.permutation(len(clear)).tolist()
            pair = clear[waiting.pop()]
            chosen, right = _trial(pair, rng)
            odds = comparison(*_augmented(pair, chosen, rng))
            logs = torch.cat((odds, none[None])).log_softmax(dim=0)
            losses.append(-logs[right])
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(comparison.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        yield step, float(loss.detach())


def _trial(pair: PosedPair, rng: np.random.Generator) -> tuple[list[int], int]:
    """Numbers of poses, and which of them is right; their number if none is."""
    wrong = np.flatnonzero(pair.wrong)
    scores = pair.poses[:, 3].astype(np.float64)
    weights = np.exp((scores[wrong] - scores.max()) / _SOFTNESS) + _ANY
    others: list[int] = []
    if len(wrong):
        count = min(_WRONG, len(wrong))
        others = rng.choice(wrong, count, replace=False, p=weights / weights.sum()).tolist()
    right = np.flatnonzero(pair.right)
    if len(right) == 0:
        return others, len(others)
    first = rng.random() < _FIRST_RIGHT
    return [int(right[0] if first else rng.choice(right)), *others], 0


def _augmented(
    pair: PosedPair, chosen: list[int], rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Features of source and target on the target's grid, which is turned at random."""
    poses = torch.from_numpy(pair.poses[chosen])
    yaws, shifts = poses[:, 0], poses[:, 1:3]
    source, target = (torch.from_numpy(each).float() for each in pair.maps)
    if rng.random() < 0.5:
        source, target = target, source
        yaws, shifts = swapped(yaws, shifts)
    kind = rng.random()
    angle = 0.0
    if kind > _STILL + _QUARTERS:
        angle = rng.random() * _TURN
    elif kind > _STILL:
        angle = float(rng.integers(1, 4)) * _TURN / 4
    if angle:
        c, s = math.cos(angle), math.sin(angle)
        yaws, shifts = yaws + angle, shifts @ torch.tensor(((c, s), (-s, c)))
        target = rotated(target, torch.tensor([angle], dtype=torch.float32))[0]
    return rotated(source, yaws, shifts), as_target(target)


def _set_scales(comparison: Comparison, pairs: Sequence[PosedPair]) -> None:
    features, products = [], []
    for pair in pairs:
        source, target = (torch.from_numpy(each).float() for each in pair.maps)
        best = torch.from_numpy(pair.poses[:1])
        moved = rotated(source, best[:, 0], best[:, 1:3])[0]
        features.append(target.square().mean(dim=(1, 2)))
        products.append((moved * as_target(target)).square().mean(dim=(1, 2)))
    for scale, squares in (
        (comparison.feature_scale, features),
        (comparison.product_scale, products),
    ):
        scale.copy_(torch.stack(squares).mean(dim=0).sqrt().clamp_min(1e-3)[:, None, None])
