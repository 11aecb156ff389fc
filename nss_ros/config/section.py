"""What all sections of settings are made of."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """A group of settings: unknown names and wrong types are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


T = TypeVar("T", bound=Section)


def in_order(section: T, *limits: tuple[str, str]) -> T:
    """The section, if the first setting of each pair is not more than the second.

    Raises:
        ValueError: naming the two settings.
    """
    for low, high in limits:
        if getattr(section, low) > getattr(section, high):
            raise ValueError(f"{low} must not be more than {high}")
    return section
