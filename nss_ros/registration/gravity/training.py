"""Trains the network of the gravity method on the score of all poses.

The loss of an overlapping pair is the cross-entropy of its true pose among all poses of the grid
and the answer "no overlap"; that of a pair apart is the cross-entropy of that answer. Of the
yaw angles, those beside the truth and a random sample of the others are evaluated; the sample
stands for all others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nss_ros.geometry import Transform
from nss_ros.registration.gravity.coarse import fast_size
from nss_ros.registration.gravity.correlation import (
    STEP,
    YAWS,
    correlate,
    rotated,
    spectrum,
)
from nss_ros.registration.gravity.network import GravityNetwork, as_target
from nss_ros.registration.gravity.raster import NORMAL_X, NORMAL_Y
from nss_ros.registration.gravity.training_data import (
    Example,
    ExampleSource,
    Item,
    relative_truth,
)
from nss_ros.registration.gravity.wide import evened, is_wide

_TURN = 2 * math.pi
#: Standard deviation of the target over the grid: what refinement can mend.
_BLUR_YAW, _BLUR_SHIFT = 0.6, 0.6


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """How the network is trained."""

    steps: int = 2000
    batch: int = 8
    other_yaws: int = 12
    learning_rate: float = 2e-3
    apart_share: float = 0.15
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Planar:
    """A pose on the plane: yaw in radians, x and y in metres."""

    yaw: float
    x: float
    y: float

    @classmethod
    def of(cls, transform: Transform) -> Planar:
        """The planar part of a transform."""
        yaw = math.atan2(transform[1, 0], transform[0, 0])
        return cls(yaw, float(transform[0, 3]), float(transform[1, 3]))


@dataclass(frozen=True, slots=True)
class Trial:
    """A pair as it is fed to the network, turned and mirrored at random.

    Attributes:
        source: maps (slices, layers, h, w) float32.
        target: maps (slices, layers, h, w) float32.
        same_stage: which head scores it.
        truth: of `T_target_source`; None: the fragments do not overlap.
    """

    source: Tensor
    target: Tensor
    same_stage: bool
    truth: Planar | None


def train(
    network: GravityNetwork, items: list[Item], config: TrainingConfig
) -> Iterator[tuple[int, float, float]]:
    """Trains the network in place; yields step, loss and share of true poses that score best."""
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    examples = ExampleSource(items, config.seed)
    optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.learning_rate, config.steps, pct_start=0.1
    )
    network.train()
    for step in range(config.steps):
        batch = [draw_trial(items, examples, config.apart_share, rng) for _ in range(config.batch)]
        optimizer.zero_grad()
        loss, hits = _loss(network, batch, config.other_yaws, rng)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        yield step, float(loss.detach()), hits
    network.eval()


def draw_trial(
    items: list[Item], examples: ExampleSource, apart_share: float, rng: np.random.Generator
) -> Trial:
    """A pair, turned by quarters and mirrored at random."""
    if rng.random() < apart_share:
        example, truth = examples.draw_apart(), None
    else:
        example = examples.draw()
        truth = Planar.of(relative_truth(items, example.source, example.target))
    return augmented(items, example, truth, rng)


def augmented(
    items: list[Item], example: Example, truth: Planar | None, rng: np.random.Generator
) -> Trial:
    """An example whose two frames are turned by quarters, and mirrored together."""
    mirror = bool(rng.random() < 0.5)
    quarters = [int(each) for each in rng.integers(4, size=2)]
    source, target = (
        _moved(torch.from_numpy(items[each].scan.maps).float(), mirror, turn)
        for each, turn in zip((example.source, example.target), quarters, strict=True)
    )
    if truth is not None:
        truth = _moved_truth(truth, mirror, *quarters)
    return Trial(source, target, example.same_stage, truth)


def _moved(maps: Tensor, mirror: bool, quarters: int) -> Tensor:
    """Maps whose y is mirrored, then turned by quarters about the sensor."""
    maps = maps.clone()
    if mirror:
        maps = maps.flip(-2)
        maps[:, NORMAL_Y] *= -1
    # Rows grow along y: turning x towards y is the opposite of what rot90 calls it.
    maps = maps.rot90(-quarters, (-2, -1))
    x, y = maps[:, NORMAL_X].clone(), maps[:, NORMAL_Y].clone()
    for _ in range(quarters):
        x, y = -y, x
    maps[:, NORMAL_X], maps[:, NORMAL_Y] = x, y
    return maps


def _moved_truth(truth: Planar, mirror: bool, source: int, target: int) -> Planar:
    yaw, x, y = truth.yaw, truth.x, truth.y
    if mirror:
        yaw, y = -yaw, -y
    for _ in range(target):
        x, y = -y, x
    return Planar((yaw + (target - source) * math.pi / 2) % _TURN, x, y)


def _loss(
    network: GravityNetwork, batch: list[Trial], other_yaws: int, rng: np.random.Generator
) -> tuple[Tensor, float]:
    losses, hits = [], []
    for trial in batch:
        # One by one: wide maps and those of the usual size do not fit into one tensor.
        source, target = (
            network.features(each[None], network(each[None]), trial.same_stage)[0]
            for each in (trial.source, trial.target)
        )
        loss, hit = _pair_loss(network, source, target, trial, other_yaws, rng)
        losses.append(loss)
        if trial.truth is not None:
            hits.append(hit)
    return torch.stack(losses).mean(), float(np.mean(hits)) if hits else float("nan")


def _pair_loss(
    network: GravityNetwork,
    source: Tensor,
    target: Tensor,
    trial: Trial,
    other_yaws: int,
    rng: np.random.Generator,
) -> tuple[Tensor, bool]:
    if is_wide(source, target):
        source = evened(source, target)
        other_yaws //= 2  # each takes ten times as long
    near = [] if trial.truth is None else _yaws_beside(trial.truth.yaw)
    rest = np.setdiff1d(np.arange(YAWS), near)
    others = rng.choice(rest, other_yaws, replace=False)
    yaws = torch.tensor([*near, *others.tolist()])
    cells = source.shape[-1], target.shape[-1]
    size = fast_size(sum(cells))
    turned = spectrum(rotated(source, yaws * (_TURN / YAWS)), size)
    scores = correlate(turned, spectrum(as_target(target), size), size)
    totals = scores.flatten(1).logsumexp(dim=1)
    weights = torch.zeros(len(yaws))
    weights[len(near) :] = math.log(len(rest) / other_yaws)
    absence = network.absence[int(trial.same_stage)] + math.log(YAWS * size**2)
    total = torch.cat((totals + weights, absence[None])).logsumexp(dim=0)
    if trial.truth is None:
        return total - absence, False
    wanted = target_distribution(trial.truth, near, *cells)
    positive = (scores[: len(near)] * wanted).sum()
    best = int(scores.detach().flatten().argmax())
    hit = bool(wanted.flatten()[best] > 1e-3) if best < wanted.numel() else False
    return total - positive, hit


def _yaws_beside(yaw: float) -> list[int]:
    middle = round(yaw / (_TURN / YAWS))
    return [(middle + each) % YAWS for each in (-1, 0, 1)]


def target_distribution(truth: Planar, yaws: list[int], source: int, target: int) -> Tensor:
    """What the poses of the grid should score, (yaws, shifts, shifts), sum 1.

    Args:
        truth: of the pair.
        yaws: numbers of yaw angles.
        source: cells of its features along each side.
        target: cells of its.
    """
    angles = np.array(yaws) * (_TURN / YAWS) - truth.yaw
    angles = (angles + math.pi) % _TURN - math.pi
    along_yaw = np.exp(-0.5 * (angles / (_BLUR_YAW * _TURN / YAWS)) ** 2)
    along_x, along_y = (_bump(each, source, target) for each in (truth.x, truth.y))
    weights = along_yaw[:, None, None] * along_y[:, None] * along_x
    return torch.from_numpy((weights / weights.sum()).astype(np.float32))


def _bump(
    shift: float, source: int, target: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    size = fast_size(source + target)
    # The shift counts from middle to middle, cells from corner to corner.
    cells = np.arange(size) - shift / STEP - (target - source) / 2
    cells = (cells + size / 2) % size - size / 2
    return np.asarray(np.exp(-0.5 * (cells / _BLUR_SHIFT) ** 2))
