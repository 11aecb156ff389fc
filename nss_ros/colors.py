"""Colours of maps and graphs, in viewers, figures and the report."""

from __future__ import annotations

Color = tuple[float, float, float]
"""Red, green and blue, 0..1."""

# Colour-blind safe (Okabe and Ito 2008), ordered so that neighbours differ in lightness too.
STAGE_COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
ACCEPTED: Color = (0.2, 0.7, 0.2)
REJECTED: Color = (0.8, 0.1, 0.1)


def stage_hex(stage: int) -> str:
    """The colour of a stage as `#rrggbb`, everywhere; stages that are six apart share one."""
    return STAGE_COLORS[stage % len(STAGE_COLORS)]


def stage_color(stage: int) -> Color:
    """The colour of a stage as numbers; see `stage_hex`."""
    text = stage_hex(stage)
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
