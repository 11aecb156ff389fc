"""Colours of maps and graphs, red green blue of 0..1, the same in every viewer."""

from __future__ import annotations

Color = tuple[float, float, float]

# Colour-blind safe (Okabe and Ito), one per stage in turn.
_STAGES: tuple[Color, ...] = (
    (0.00, 0.45, 0.70),
    (0.90, 0.62, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.34, 0.71, 0.91),
    (0.84, 0.37, 0.00),
)
ACCEPTED: Color = (0.2, 0.7, 0.2)
REJECTED: Color = (0.8, 0.1, 0.1)


def stage_color(stage: int) -> Color:
    """The colour of a stage; stages that are six apart share one."""
    return _STAGES[stage % len(_STAGES)]
