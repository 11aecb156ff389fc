"""Settings of simulated sites and of their scans."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from nss_ros.config.section import Fraction, Positive, Section, in_order


class ViewpointConfig(Section):
    """Where the tripod is put."""

    spots_per_stage: int = Field(
        0,
        ge=0,
        le=10_000,
        description="Most spots per stage, all stages then beginning near the same place; 0: until "
        "coverage stops growing",
    )
    least_gain: Positive = Field(
        1.0, description="Floor that a further spot must be the first to see, square metres"
    )
    cell_size: float = Field(0.1, ge=0.02, le=1, description="Cells of the occupancy map, metres")
    min_height: Positive = Field(0.5, description="Lowest obstacle above the floor, metres")
    max_height: Positive = Field(2.0, description="Highest obstacle above the floor, metres")
    floor_tolerance: Positive = Field(
        0.3, description="Surfaces this far above or below the floor height are floor, metres"
    )
    min_clearance: Positive = Field(0.5, description="Least distance from obstacles, metres")
    passage: Positive = Field(
        0.25, description="Clearance that a person needs to get through, metres"
    )
    min_region: Fraction = Field(
        1.0,
        description="Free floor apart from the largest region counts as reachable if its area is "
        "at least this share of the largest; 1: only the largest region",
    )
    min_spacing: Positive = Field(1.0, description="Least distance between spots, metres")
    max_spacing: Positive = Field(4.0, description="Longest distance to the nearest spot, metres")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return in_order(self, ("min_height", "max_height"), ("min_spacing", "max_spacing"))


class RigConfig(Section):
    """Three depth sensors on a turning tripod head (Matterport with PrimeSense sensors)."""

    horizontal_fov: float = Field(58.0, gt=0, lt=120, description="Field of view, degrees")
    vertical_fov: float = Field(45.0, gt=0, lt=120, description="Field of view, degrees")
    image_width: int = Field(160, ge=8, le=1280, description="Pixels of a depth image")
    image_height: int = Field(120, ge=8, le=1024, description="Pixels of a depth image")
    min_range: Positive = Field(0.4, description="Nearer surfaces give no return, metres")
    max_range: Positive = Field(4.5, description="Points farther away are cut, metres")
    axial_noise: float = Field(
        0.0015, ge=0, description="Depth noise at 1 m, growing with its square, metres sigma"
    )
    disparity_step: float = Field(
        1 / 350, ge=0, description="Depth quantisation at 1 m, growing with its square, metres"
    )
    lateral_noise: float = Field(0.05, ge=0, description="Jitter of the rays, degrees sigma")
    grazing_start: float = Field(
        70.0, ge=0, lt=90, description="Incidence from which returns get lost, degrees"
    )
    grazing_end: float = Field(
        85.0, gt=0, le=90, description="Incidence from which there are none, degrees"
    )
    metal_grazing_start: float = Field(
        40.0, ge=0, lt=90, description="The same of metal, which shines, degrees"
    )
    metal_grazing_end: float = Field(75.0, gt=0, le=90, description="The same of metal, degrees")
    dark_range_start: Positive = Field(
        1.5, description="Range from which returns of dark surfaces get lost, metres"
    )
    dark_range_end: Positive = Field(
        3.5, description="Range from which dark surfaces give none, metres"
    )
    glass_return: Fraction = Field(0.03, description="Share of returns that glass gives")
    dropout: Fraction = Field(0.02, description="Share of returns lost anywhere")
    min_tripod_height: Positive = Field(1.5, description="Sensor above the floor, metres")
    max_tripod_height: Positive = Field(1.75, description="Sensor above the floor, metres")
    tilt: float = Field(0.5, ge=0, description="Sigma of the tripod's tilt per axis, degrees")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return in_order(
            self,
            ("min_range", "max_range"),
            ("grazing_start", "grazing_end"),
            ("metal_grazing_start", "metal_grazing_end"),
            ("dark_range_start", "dark_range_end"),
            ("min_tripod_height", "max_tripod_height"),
        )


class SimulationConfig(Section):
    """How sites are scanned."""

    seed: int = Field(0, ge=0, description="Same seed, sites and settings: the same bytes")
    voxel_size: Positive = Field(
        0.075, description="Voxel size of the fragments, as in the NSS release, metres"
    )
    viewpoints: ViewpointConfig = ViewpointConfig()
    rig: RigConfig = RigConfig()
    panorama: bool = Field(False, description="Make a depth panorama of every fragment, too")
    panorama_height: int = Field(
        512, ge=16, le=4096, description="Rows of a panorama; it has twice as many columns"
    )
