"""What can be trained: one entry for each learned baseline."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.registration.learned.training.d3feat import D3FeatTrainee
from nss_ros.registration.learned.training.example import Example
from nss_ros.registration.learned.training.fcgf import FcgfTrainee
from nss_ros.registration.learned.training.geotransformer import GeoTransformerTrainee
from nss_ros.registration.learned.training.predator import PredatorTrainee


class Trainee(Protocol):
    """A network that learns from examples."""

    @property
    def network(self) -> nn.Module:
        """On its device; its `state_dict` becomes the checkpoint."""
        ...

    @property
    def learning_rate(self) -> float:
        """The largest one that suits it."""
        ...

    def prepare(self, example: Example, random: np.random.Generator) -> Any | None:
        """What the losses are calculated from; None where a pair has too little in common.

        Called from several threads, without gradients.
        """
        ...

    def losses(self, prepared: Any) -> Mapping[str, Tensor]:
        """Losses by name; their sum is what is minimised."""
        ...


TRAINEES: dict[str, Callable[[RegistrationConfig, torch.device], Trainee]] = {
    "fcgf": FcgfTrainee,
    "d3feat": D3FeatTrainee,
    "predator": PredatorTrainee,
    "geotransformer": GeoTransformerTrainee,
}


def new_trainee(method: str, config: RegistrationConfig, device: torch.device) -> Trainee:
    """An untrained network of a learned baseline; its weights are drawn by torch's generator.

    Args:
        method: registered name.
        config: of registration; the voxel size is that of the method's section.
        device: where it is trained.

    Raises:
        MethodError: the method is not one that this trains.
    """
    if method not in TRAINEES:
        raise MethodError(
            f"Method '{method}' cannot be trained here: choose one of {', '.join(TRAINEES)}."
        )
    return TRAINEES[method](config, device)
