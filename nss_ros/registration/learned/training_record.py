"""What weights were trained on, as told by a checkpoint that `nss train` wrote."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import Any

#: Under this name a checkpoint keeps its record, as JSON.
RECORD_KEY = "training"


@dataclass(frozen=True, slots=True)
class TrainingRecord:
    """Where weights come from.

    Attributes:
        method: registered name.
        voxel_size: of the method while it learned, metres.
        poses: digest of the poses of the dataset, which no other dataset has.
        sets: digest of what decides which of its pairs are to learn from.
        split: whose training pairs were learned from.
        same_stage_only: whether pairs of different stages were left out.
        count: of the pairs that there were to learn from.
        seed: of the first weights and of all that is drawn.
        settings: of training, by name.
        version: of this package.
    """

    method: str
    voxel_size: float
    poses: str
    sets: str
    split: str
    same_stage_only: bool
    count: int
    seed: int
    settings: dict[str, Any]
    version: str

    @property
    def stages(self) -> str:
        """For tables: pairs of which stages were learned from."""
        return "same_stage" if self.same_stage_only else "all_stages"

    def to_json(self) -> str:
        """For a checkpoint."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: object) -> TrainingRecord | None:
        """The record of a checkpoint; None if it is none of ours."""
        try:
            values = json.loads(text) if isinstance(text, str) else None
        except ValueError:
            return None
        names = {field.name for field in fields(cls)}
        return cls(**values) if isinstance(values, dict) and names == values.keys() else None

    def difference(self, other: TrainingRecord) -> str:
        """The first thing in which another record differs, in words; empty if in nothing."""
        mine, theirs = (_flat(asdict(each)) for each in (self, other))
        for name in sorted(mine.keys() | theirs.keys()):
            if mine.get(name) != theirs.get(name):
                return f"{name} is {theirs.get(name)!r} there and {mine.get(name)!r} here"
        return ""


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    inner = values.pop("settings")
    return values | {f"training.{name}": each for name, each in inner.items()}
