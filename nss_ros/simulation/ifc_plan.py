"""Which elements of a building model are there at which stage, and in what state."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime
from enum import StrEnum
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from nss_ros.config.section import Positive, Section
from nss_ros.errors import FormatError, InputError
from nss_ros.simulation.element import Material


class State(StrEnum):
    """How far an element is built."""

    BUILT = "built"
    TRACK = "track"
    STUDS = "studs"
    ONE_SIDE = "one_side"
    PROPPED = "propped"
    STACKED = "stacked"
    ABSENT = "absent"


class IfcRule(Section):
    """Elements, and when they are there. All conditions that are given must hold."""

    file: str = Field("*", description="Shell pattern of the file's name")
    ifc_class: list[str] = Field([], description="IFC classes, subclasses included; none: all")
    name: str = Field("*", description="Shell pattern of the element's name, case ignored")
    name_regex: str = Field("", description="Regular expression that the name must contain")
    storey: str = Field("*", description="Shell pattern of the storey that contains it")
    property: str = Field("", description="Property as Set.Name that must be there")
    value: str = Field("*", description="Shell pattern of that property's value")
    states: dict[int, State] = Field(
        {}, description="State from that stage on, e.g. {2: studs, 3: built}; before it: absent"
    )
    material: Literal["", "matt", "dark", "metal", "glass"] = Field(
        "", description="What a depth sensor meets; none: told by class, names and styles"
    )
    by_schedule: bool = Field(
        False, description="Built from the stage on whose date its task's finish does not exceed"
    )

    @model_validator(mode="after")
    def _timed(self) -> Self:
        if self.by_schedule == bool(self.states):
            raise ValueError("a rule needs either 'states' or 'by_schedule: true'")
        try:
            re.compile(self.name_regex)
        except re.error as error:
            raise ValueError(f"'name_regex' is not a regular expression: {error}") from error
        return self


class IfcStage(Section):
    """One stage."""

    name: str = Field("", description="What it is, for people")
    day: date | None = Field(
        None, alias="date", description="Date of the scan, for rules by schedule"
    )


class IfcArea(Section):
    """An area given as a storey of one or several IFC files of one building."""

    files: list[str] = Field(min_length=1, description="IFC files, shell patterns allowed")
    storey: str = Field(
        "", description="Shell pattern of the storey's name; none: that of most elements"
    )
    floor: float | None = Field(
        None,
        description="Height of the floor in the model, metres; none: that of the largest level "
        "surface near the storey's",
    )
    ceiling: float | None = Field(
        None, description="Height up to which elements count, metres; none: the next storey's"
    )
    margin: Positive = Field(
        0.6,
        description="Slabs this far below or above still count, and what goes on farther is cut, "
        "metres",
    )
    stages: list[IfcStage] = Field([], description="Stages in order; none: by the order of works")
    rules: list[IfcRule] = Field(
        [], description="Of several rules that hold, the first counts; elements of none are absent"
    )
    schedule: str = Field(
        "", description="CSV file with GlobalId and finish, in addition to the tasks in the files"
    )
    stud_spacing: Positive = Field(0.6, description="Distance of studs, metres")
    clutter: float = Field(
        0.0,
        ge=0,
        le=3,
        description="Things that lie about and move between stages (stacks, scaffolds, lifts, "
        "bins), as a factor of their usual number; 0: none",
    )
    ground: bool = Field(True, description="Add a floor slab where the model has none")
    cache: str = Field("", description="Folder of tessellations; none: ~/.cache/nss_ros/ifc")

    @model_validator(mode="after")
    def _planned(self) -> Self:
        if bool(self.rules) != bool(self.stages):
            raise ValueError("'stages' and 'rules' go together: give both, or neither")
        last = len(self.stages)
        for rule in self.rules:
            for stage in rule.states:
                if not 1 <= stage <= last:
                    raise ValueError(f"a rule names stage {stage}, but there are 1 to {last}")
        scheduled = any(rule.by_schedule for rule in self.rules)
        if scheduled and any(stage.day is None for stage in self.stages):
            raise ValueError("every stage needs a 'date' for rules by schedule")
        return self


@dataclass(frozen=True, slots=True)
class IfcFacts:
    """What rules can ask of an element.

    Attributes:
        file: name of its file.
        classes: its IFC class and those above it; of a part of a wall, then those of the wall.
        name: its name, empty for none.
        global_id: its GlobalId.
        storey: name of the storey that contains it, empty for none.
        properties: by `Set.Name`.
        finish: of its latest task.
        materials: names of its materials.
    """

    file: str
    classes: tuple[str, ...]
    name: str
    global_id: str
    storey: str = ""
    properties: Mapping[str, str] = field(default_factory=dict)
    finish: date | None = None
    materials: tuple[str, ...] = ()


# The usual order of works.
_STRUCTURE = [
    *("IfcFooting", "IfcPile", "IfcColumn", "IfcBeam", "IfcRoof", "IfcStair", "IfcStairFlight"),
    *("IfcRamp", "IfcRampFlight", "IfcReinforcingElement"),
]
_ROUGH = ["IfcDistributionElement", "IfcPlate", "IfcMember", "IfcCurtainWall", "IfcWindow"]
_FINISH = ["IfcDoor", "IfcCovering", "IfcFurnishingElement", "IfcRailing"]
_WALLS = ["IfcWall"]
_LOAD_BEARING, _EXTERNAL = "Pset_WallCommon.LoadBearing", "Pset_WallCommon.IsExternal"
_FROM_SHELL, _FROM_ROUGH, _FROM_FINISH = ({stage: State.BUILT} for stage in (1, 2, 3))


def default_plan(area: IfcArea) -> tuple[list[IfcStage], list[IfcRule]]:
    """Stages and rules of an area; without any, those of the usual order of works.

    Shell: structure and load-bearing or external walls, slabs under props. Rough: windows,
    curtain walls, services, the other walls as studs. Finished: walls closed, doors, coverings,
    furniture.
    """
    if area.rules:
        return area.stages, area.rules
    stages = [IfcStage(name=name) for name in ("shell", "rough", "finished")]
    partition = {2: State.STUDS, 3: State.BUILT}
    rules = [
        IfcRule(ifc_class=["IfcSlab"], states={1: State.PROPPED, 2: State.BUILT}),
        IfcRule(ifc_class=_STRUCTURE, states=_FROM_SHELL),
        IfcRule(ifc_class=_WALLS, property=_LOAD_BEARING, value="True", states=_FROM_SHELL),
        IfcRule(ifc_class=_WALLS, property=_EXTERNAL, value="True", states=_FROM_SHELL),
        IfcRule(ifc_class=_WALLS, property=_LOAD_BEARING, value="False", states=partition),
        IfcRule(ifc_class=_ROUGH, states=_FROM_ROUGH),
        IfcRule(ifc_class=_FINISH, states=_FROM_FINISH),
        IfcRule(states=_FROM_SHELL),
    ]
    return stages, rules


def states_of(
    facts: IfcFacts, stages: Sequence[IfcStage], rules: Sequence[IfcRule]
) -> dict[State, frozenset[int]]:
    """The stages at which an element is in each state; empty if it is never there."""
    holding = holding_rules(facts, rules)
    if not holding:
        return {}
    rule = rules[holding[0]]
    if rule.by_schedule:
        steps = dict.fromkeys(_built_stages(facts.finish, stages), State.BUILT)
    else:
        steps = rule.states
    found: dict[State, set[int]] = {}
    state = State.ABSENT
    for stage in range(1, len(stages) + 1):
        state = steps.get(stage, state)
        if state is not State.ABSENT:
            found.setdefault(state, set()).add(stage)
    return {state: frozenset(numbers) for state, numbers in found.items()}


def ruled_material(facts: IfcFacts, rules: Sequence[IfcRule]) -> Material | None:
    """The material that the rule of an element gives it, None if it does not."""
    holding = holding_rules(facts, rules)
    named = rules[holding[0]].material if holding else ""
    return Material[named.upper()] if named else None


def holding_rules(facts: IfcFacts, rules: Sequence[IfcRule]) -> list[int]:
    """Indices of the rules that hold for an element; the first of them counts."""
    return [index for index, rule in enumerate(rules) if _holds(rule, facts)]


def read_schedule(path: Path) -> dict[str, date]:
    """Finish of elements by GlobalId, from a CSV file with the columns GlobalId and finish.

    Raises:
        InputError: the file is missing.
        FormatError: a column or a date is not valid.
    """
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines()))
    except OSError as error:
        raise InputError(f"Cannot read the schedule {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"The schedule {path} is not UTF-8 text.") from error
    if rows and not {"GlobalId", "finish"} <= rows[0].keys():
        raise FormatError(f"The schedule {path} needs the columns GlobalId and finish.")
    dates: dict[str, date] = {}
    for number, row in enumerate(rows, start=2):
        try:
            dates[row["GlobalId"]] = _day(row["finish"])
        except ValueError as error:
            raise FormatError(
                f"Line {number} of the schedule {path} has no ISO date as finish: "
                f"{row['finish']!r}."
            ) from error
    return dates


def parse_date(text: Any) -> date | None:
    """The day of an ISO time stamp in a model; None if it is none."""
    try:
        return _day(str(text))
    except ValueError:
        return None


def _holds(rule: IfcRule, facts: IfcFacts) -> bool:
    value = facts.properties.get(rule.property)
    return (
        fnmatch(facts.file, rule.file)
        and (not rule.ifc_class or any(name in facts.classes for name in rule.ifc_class))
        and fnmatch(facts.name.lower(), rule.name.lower())
        and re.search(rule.name_regex, facts.name) is not None
        and fnmatch(facts.storey, rule.storey)
        and (not rule.property or (value is not None and fnmatch(value, rule.value)))
    )


def _built_stages(finish: date | None, stages: Sequence[IfcStage]) -> list[int]:
    if finish is None:
        return []
    days = [stage.day for stage in stages]
    return [number for number, day in enumerate(days, start=1) if day and finish <= day]


def _day(text: str) -> date:
    return datetime.fromisoformat(text.strip()).date()
