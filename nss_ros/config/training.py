"""Settings of how the learned baselines are trained."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from nss_ros.config.section import Fraction, Section


class TrainingConfig(Section):
    """How a learned baseline is trained on the training pairs of a dataset."""

    steps: int = Field(20_000, gt=0, description="Steps of the optimiser")
    batch: int = Field(1, gt=0, description="Pairs in a step")
    learning_rate: float = Field(
        0.0,
        ge=0,
        description="The largest one; it rises at first and then falls to zero. 0: that of the method",
    )
    weight_decay: float = Field(1e-6, ge=0, description="Of the weights, as AdamW has it")
    min_overlap: Fraction = Field(0.3, description="Least overlap ratio of the pairs to learn from")
    rotations: Literal["level", "any"] = Field(
        "level",
        description="How fragments are turned at random: about their vertical, with a tilt of a few degrees, or in any way, as the methods' authors do",
    )
    threads: int = Field(
        1, gt=0, description="Of the processor; more are quicker, and give other last digits"
    )
    noise: float = Field(0.005, ge=0, description="Standard deviation of noise on points, metres")
    validation_pairs: int = Field(50, ge=0, description="Validation pairs whose loss is told")
    save_every: int = Field(
        500,
        gt=0,
        description="Steps after which the state is saved and validation pairs are looked at",
    )
