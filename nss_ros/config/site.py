"""Settings of the procedural construction floor."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from nss_ros.config.section import Fraction, Section

_MIN_RADIUS = 1.5  # of a curved wing's middle, in depths of the floor

Use = Literal["office", "residential", "hospital", "laboratory"]
#: What can be left out of a floor.
Part = Literal["ceiling_slab", "beam", "prop", "facade", "services", "ceilings", "contents"]


class WingConfig(Section):
    """A further wing, joined to the end of the one before it."""

    length: float = Field(ge=12, le=120, description="Length along its middle, metres")
    turn: float = Field(
        0.0, ge=-120, le=120, description="Its direction against the wing before, degrees, left +"
    )
    arc: float = Field(
        0.0, ge=-180, le=180, description="How far it bends along its length, degrees, left +"
    )


class SiteConfig(Section):
    """The procedural construction floor."""

    stages: int = Field(3, ge=1, le=6, description="Number of stages, spread over the works")
    use: Use = Field("office", description="What the floor is built for, which sets its rooms")
    width: float = Field(16.0, ge=14, le=120, description="Length of the first wing, metres")
    depth: float = Field(
        12.0, ge=11, le=40, description="Clear distance between the two long facades, metres"
    )
    height: float = Field(3.2, ge=3.0, le=4.5, description="Floor slab to ceiling slab, metres")
    wings: tuple[WingConfig, ...] = Field(
        (), max_length=6, description="Further wings, each at the end of the one before"
    )
    renovation: bool = Field(
        False, description="Starts in use, is stripped out, then gets a new layout"
    )
    repetition: Fraction = Field(
        0.8, description="How alike the rooms are: 1 for copies, 0 for rooms drawn one by one"
    )
    clutter: float = Field(
        1.0, ge=0, le=3, description="Factor of the number of things that lie about"
    )
    temporary: float = Field(
        0.0,
        ge=0,
        le=3,
        description="Factor of the number of small and hanging things of the works: offcuts, sacks, "
        "lamps, hoses, cables, dust sheets; 0: none",
    )
    pace: float = Field(1.0, gt=0, le=2, description="Factor of the work done between stages")
    stagger: float = Field(
        1.0, ge=0, le=3, description="Factor of how far the zones of a floor are out of step"
    )
    deviation: float = Field(
        1.0, ge=0, le=5, description="Factor of the deviations of what is built from its plan"
    )

    without: tuple[Part, ...] = Field(
        (), description="Parts left out, as in many design models: no ceiling slab, no services"
    )

    @model_validator(mode="after")
    def _bends(self) -> Self:
        for wing in self.wings:
            if abs(math.radians(wing.arc)) * self.depth * _MIN_RADIUS > wing.length:
                raise ValueError(
                    f"a wing of length {wing.length:g} and depth {self.depth:g} cannot bend by an "
                    f"arc of {wing.arc:g} degrees: make it longer or the arc smaller"
                )
        return self
