"""What a plan does not do: rules that match nothing, and elements that it forgets."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence

from nss_ros.simulation.ifc_plan import IfcArea, IfcFacts, IfcRule, default_plan, holding_rules

_MOST_CLASSES = 6


def plan_report(
    name: str, area: IfcArea, everything: Sequence[IfcFacts], storey: Sequence[IfcFacts]
) -> list[str]:
    """One sentence for each thing that the author of a plan should know.

    Args:
        name: of the area.
        area: with its plan, or none.
        everything: all elements of the files; a rule may be for another storey.
        storey: those of the area.
    """
    _, rules = default_plan(area)
    if not area.rules:
        return _outside_the_usual_order(name, rules, storey)
    holding = [holding_rules(facts, rules) for facts in everything]
    own = [holding_rules(facts, rules) for facts in storey]
    first = Counter(found[0] for found in holding if found)
    at_all = Counter(index for found in holding for index in found)
    sentences = []
    for index, rule in enumerate(rules):
        if not at_all[index]:
            sentences.append(
                f"Area {name}: rule {index + 1} {_text(rule)} matches no element of the files; "
                "mend its conditions, or take it out."
            )
        elif not first[index]:
            sentences.append(
                f"Area {name}: rule {index + 1} {_text(rule)} does nothing, since earlier rules "
                f"take all {at_all[index]} elements that it matches; move it up."
            )
    forgotten = [facts for facts, found in zip(storey, own, strict=True) if not found]
    if forgotten:
        sentences.append(
            f"Area {name}: no rule matches {len(forgotten)} elements, which are left out at all "
            f"stages: {_classes(forgotten)}; add a rule for them, or {{states: {{1: built}}}} at "
            "the end."
        )
    undated = [
        facts
        for facts, found in zip(storey, own, strict=True)
        if found and rules[found[0]].by_schedule and facts.finish is None
    ]
    if undated:
        sentences.append(
            f"Area {name}: {len(undated)} elements of rules by schedule have no date, and are left "
            f"out at all stages: {_classes(undated)}; add them to the schedule."
        )
    return sentences


def _outside_the_usual_order(
    name: str, rules: Sequence[IfcRule], storey: Sequence[IfcFacts]
) -> list[str]:
    last = len(rules) - 1
    others = [facts for facts in storey if holding_rules(facts, rules)[0] == last]
    if not others:
        return []
    return [
        f"Area {name}: what has no place in the usual order of works (such as walls of which "
        f"nothing says whether they bear loads) is there from the first stage on: "
        f"{_classes(others)}; a plan of your own can stage it."
    ]


def _text(rule: IfcRule) -> str:
    return json.dumps(rule.model_dump(mode="json", exclude_defaults=True)).replace('"', "")


def _classes(elements: Iterable[IfcFacts]) -> str:
    counts = sorted(Counter(facts.classes[0] for facts in elements).items(), key=_by_count)
    told = [f"{count} {name}" for name, count in counts[:_MOST_CLASSES]]
    rest = sum(count for _, count in counts[_MOST_CLASSES:])
    return ", ".join([*told, *([f"{rest} others"] if rest else [])])


def _by_count(item: tuple[str, int]) -> tuple[int, str]:
    return -item[1], item[0]
