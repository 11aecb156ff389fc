"""Trains a network step by step; a run that was killed goes on from what it saved last."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import nn

from nss_ros.config import TrainingConfig
from nss_ros.errors import RunError
from nss_ros.registration.learned.training.example import ExampleSource
from nss_ros.registration.learned.training.trainee import Trainee

# Steps for which pairs are prepared in advance, and threads that do so.
_AHEAD, _THREADS = 4, 2
_WARM_UP = 0.05
_LARGEST_GRADIENT = 5.0
# Numbers tried for a pair that has enough in common.
_ATTEMPTS = 100

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Report:
    """Where training is.

    Attributes:
        step: steps that are done.
        losses: by name, means over the batch of the step.
        validation: mean loss of the validation pairs; None but where state is to be saved.
    """

    step: int
    losses: Mapping[str, float]
    validation: float | None


class Trainer:
    """Steps of the optimiser, AdamW with a rate that rises, then falls along a cosine.

    Args:
        trainee: the network.
        learned: pairs to learn from.
        validation: pairs whose loss is told, and how many.
        config: of training.
    """

    def __init__(
        self,
        trainee: Trainee,
        learned: ExampleSource,
        validation: tuple[ExampleSource, int],
        config: TrainingConfig,
    ) -> None:
        self._trainee = trainee
        self._learned = learned
        self._validation = validation
        self._config = config
        self._optimizer = torch.optim.AdamW(
            trainee.network.parameters(), weight_decay=config.weight_decay
        )
        self._rate = config.learning_rate or trainee.learning_rate
        self.step = 0

    def state(self) -> dict[str, Any]:
        """All that is needed to go on."""
        return {
            "state_dict": self._trainee.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "step": self.step,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a state."""
        self._trainee.network.load_state_dict(state["state_dict"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.step = int(state["step"])

    def steps(self) -> Iterator[Report]:
        """Do the steps that are left.

        Raises:
            RunError: a loss is not a number any more, or pairs have too little in common.
            FormatError: a fragment cannot be read.
        """
        batch = self._config.batch
        numbers = iter(range(self.step * batch, self._config.steps * batch))
        prepared = ahead(self._prepared, numbers, _AHEAD * batch)
        while self.step < self._config.steps:
            losses = self._step([next(prepared) for _ in range(batch)])
            self.step += 1
            due = self.step % self._config.save_every == 0 or self.step == self._config.steps
            yield Report(self.step, losses, self._validated() if due else None)

    def _step(self, batch: list[Any]) -> dict[str, float]:
        network = self._trainee.network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate * share_of_rate(self.step / self._config.steps)
        self._optimizer.zero_grad(set_to_none=True)
        told: dict[str, float] = {}
        for each in batch:
            losses = self._trainee.losses(each)
            total = torch.stack(list(losses.values())).sum() / len(batch)
            if not torch.isfinite(total):
                raise RunError(
                    f"The loss of step {self.step + 1} is not a number: lower "
                    "training.learning_rate and begin anew."
                )
            total.backward()  # type: ignore[no-untyped-call]
            for name, loss in losses.items():
                told[name] = told.get(name, 0.0) + float(loss.detach()) / len(batch)
        nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
        self._optimizer.step()
        return told

    def _prepared(self, number: int) -> Any:
        """Of the pair of a number, or of the next one that has enough in common."""
        for attempt in range(_ATTEMPTS):
            example, random = self._learned.drawn(number, attempt)
            prepared = self._trainee.prepare(example, random)
            if prepared is not None:
                return prepared
        raise RunError(
            f"Of {_ATTEMPTS} training pairs in a row none has enough points in common: is the "
            "voxel size of the method too small for these fragments, or training.min_overlap?"
        )

    def _validated(self) -> float:
        """The mean loss of the validation pairs; not a number if there are none."""
        source, count = self._validation
        network = self._trainee.network.eval()
        found = []
        with torch.no_grad():
            for prepared in ahead(
                lambda place: self._trainee.prepare(*source.at(place)), iter(range(count)), _AHEAD
            ):
                if prepared is not None:
                    losses = self._trainee.losses(prepared)
                    found.append(float(torch.stack(list(losses.values())).sum()))
        network.train()
        return float(np.mean(found)) if found else math.nan


def share_of_rate(progress: float) -> float:
    """The learning rate at a share of all steps, as a share of the largest one."""
    if progress < _WARM_UP:
        return (progress + 1e-3) / (_WARM_UP + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (progress - _WARM_UP) / (1 - _WARM_UP)))


def ahead(work: Callable[[int], T], numbers: Iterator[int], count: int) -> Iterator[T]:
    """What work makes of numbers, in their order, by threads that are a little ahead."""
    with ThreadPoolExecutor(_THREADS) as pool:
        waiting: deque[Future[T]] = deque()
        try:
            for number in numbers:
                waiting.append(pool.submit(work, number))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for each in waiting:
                each.cancel()
