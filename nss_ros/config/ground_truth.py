"""Settings of ground truth: aligning the stages, and refining that locally."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from nss_ros.config.section import Positive, Section, in_order


class AlignmentConfig(Section):
    """Stages aligned by picked points, then by ICP, to an anchor stage."""

    max_residual: Positive = Field(
        0.5, description="A picked pair that misses by more is an error, metres"
    )
    usual_residual: Positive = Field(
        0.1, description="A picked pair that misses by more is warned of, metres"
    )
    min_spread: Positive = Field(
        0.5, description="Least distance of some picked point from the line through them, metres"
    )
    voxel_size: Positive = Field(0.1, description="Voxel size of the stage scans, metres")
    max_distance: Positive = Field(
        0.2, description="Longest correspondence of the last level of ICP, metres; twice at first"
    )
    kernel: Positive = Field(
        0.05, description="Point-to-plane distance from which a correspondence fades, metres"
    )
    iterations: int = Field(40, gt=0, description="Most iterations of ICP per level")
    max_points: int = Field(50_000, gt=0, description="Points of a stage used in ICP")
    max_correction: Positive = Field(
        1.0, description="ICP that moves a picked point by more is not believed, metres"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return in_order(self, ("usual_residual", "max_residual"))


class RefinementConfig(Section):
    """Local refinement of ground truth between stages (NSS paper, cylinders around the spots)."""

    radius: Positive = Field(12.0, description="Radius of the cylinders around the spots, metres")
    voxel_size: Positive = Field(0.1, description="Voxel size of the stage scans, metres")
    max_distance: Positive = Field(
        0.15, description="Longest correspondence of the last level, metres; twice that at first"
    )
    kernel: Positive = Field(
        0.03, description="Point-to-plane distance from which a correspondence fades, metres"
    )
    iterations: int = Field(40, gt=0, description="Most iterations of ICP per level")
    max_points: int = Field(10_000, gt=0, description="Source points used, drawn at random")
    min_correspondences: int = Field(
        500, ge=6, description="With fewer, the global alignment stands"
    )
    max_deviation: Positive = Field(
        0.02, description="With a larger standard deviation, the global alignment stands, metres"
    )
    max_translation: Positive = Field(
        0.3, description="A larger correction is not believed, metres"
    )
    max_rotation: Positive = Field(2.0, description="A larger correction is not believed, degrees")
