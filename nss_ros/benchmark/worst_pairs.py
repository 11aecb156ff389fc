"""The worst answers as pictures: target and source, at the estimate and as it truly is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nss_ros.bag import Log
from nss_ros.benchmark.evaluation import Evaluation
from nss_ros.benchmark.map_figures import draw_plan, draw_section, limits
from nss_ros.benchmark.pair_records import Outcome, PairRecord
from nss_ros.dataset.figures import STYLE
from nss_ros.fragment import Points
from nss_ros.geometry import transform_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TARGET, ESTIMATE, TRUTH = "#7a7a7a", "#D55E00", "#009E73"
"""Colours of the target, and of the source at the estimate and as it truly is."""

_SLICE = 0.25, 2.1  # above the floor, metres
_SIZE = 7.6, 4.4  # inches


@dataclass(frozen=True, slots=True)
class WorstPair:
    """An answer that is wrong.

    Attributes:
        record: of the pair.
        why: it is shown, for people.
    """

    record: PairRecord
    why: str


def worst_pairs(log: Log, records: Sequence[PairRecord], count: int) -> list[WorstPair]:
    """The answers with the largest errors, and those that are wrong with most confidence.

    Args:
        log: pairs without the point clouds of both are left out.
        records: of the run, worst first.
        count: at most so many.
    """
    wrong = [
        record
        for record in records
        if record.outcome is Outcome.WRONG
        and record.edge is not None
        and {record.pair.source, record.pair.target} <= log.fragments.keys()
    ]
    confident = sorted(wrong, key=lambda record: -record.confidence)
    chosen: dict[int, WorstPair] = {}
    for record in confident[: count // 2]:
        chosen[id(record)] = WorstPair(record, "wrong with most confidence")
    for record in wrong:
        if len(chosen) == min(count, len(wrong)):
            break
        chosen.setdefault(id(record), WorstPair(record, "largest error"))
    order = {"wrong with most confidence": 0, "largest error": 1}
    return sorted(chosen.values(), key=lambda each: order[each.why])


def pair_figure(log: Log, evaluation: Evaluation, record: PairRecord) -> Figure:
    """A pair in plan and section: the source at the estimate on the left, in truth on the right.

    Args:
        log: with the point clouds of both.
        evaluation: of the log.
        record: with an answer, of an edge of the ground truth.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    if record.edge is None:
        raise ValueError(f"{record.pair} is no edge of the ground truth.")
    target = log.fragments[record.pair.target].points
    source = log.fragments[record.pair.source].points
    sides = (
        (
            "Source at the estimate",
            ESTIMATE,
            evaluation.edges.pairwise.T_target_source[record.edge],
        ),
        ("Source in truth", TRUTH, evaluation.edges.T_target_source[record.edge]),
    )
    moved = [transform_points(T, source).astype(np.float32) for _, _, T in sides]
    low, high = limits([target, *moved])
    heights = _slice(target)
    with mpl.rc_context(STYLE):
        spans = high - low
        height = (_SIZE[0] / 2 - 0.6) * (spans[1] + spans[2]) / spans[0] + 1.0
        figure = Figure(figsize=(_SIZE[0], float(np.clip(height, 2.6, 7.5))), layout="compressed")
        grid = figure.subplots(2, 2, sharex=True, height_ratios=(spans[1], spans[2]))
        for column, ((name, colour, _), points) in enumerate(zip(sides, moved, strict=True)):
            plan, section = grid[:, column]
            inks = {TARGET: target, colour: points}
            draw_plan(plan, inks, low, high, heights)
            draw_section(section, inks, low, high)
            plan.set_title(name, color=colour)
            section.set_xlabel("x (m)")
            if column:
                plan.tick_params(labelleft=False)
                section.tick_params(labelleft=False)
        grid[0, 0].set_ylabel("y (m)")
        grid[1, 0].set_ylabel("z (m)")
    return figure


def _slice(target: Points) -> tuple[float, float]:
    floor = float(np.percentile(target[:, 2], 2))
    return floor + _SLICE[0], floor + _SLICE[1]
