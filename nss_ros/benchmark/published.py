"""The NSS paper's own figures, as far as their source is at hand; see `paper.yaml`."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import yaml
from pydantic import BaseModel, ConfigDict


class PublishedRecall(BaseModel):
    """Registration recall of a method on one split of the NSS data, percent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    split: str
    method: str
    same_stage: float
    different_stage: float


class PublishedTraining(PublishedRecall):
    """The same of a method that was trained on some pairs only, for example `same_stage`."""

    training: str


class Published(BaseModel):
    """Published figures with their source.

    Attributes:
        source: the publication.
        pairwise: of methods trained on all pairs.
        training: of the table of methods trained on same-stage pairs only.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str
    pairwise: tuple[PublishedRecall, ...]
    training: tuple[PublishedTraining, ...]


@cache
def published() -> Published:
    """The figures that ship with the package."""
    text = files("nss_ros.benchmark").joinpath("paper.yaml").read_text(encoding="utf-8")
    return Published.model_validate(yaml.safe_load(text))
