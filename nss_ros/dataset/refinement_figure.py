"""The plot from which the radius of the cylinders is chosen (NSS paper, ground truth)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nss_ros.dataset.refinement import RadiusStatistics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CURVES: tuple[tuple[str, Callable[[RadiusStatistics], float]], ...] = (
    ("residual of ICP (rmse)", lambda row: row.rmse),
    ("spread of repeated subsamples", lambda row: row.spread),
    ("change since the radius before", lambda row: row.step),
    ("error against the truth", lambda row: row.error),
)


def radius_figure(study: Sequence[RadiusStatistics], chosen: float | None = None) -> Figure:
    """Residual, spread, change and (where it is known) error over the radius, millimetres.

    Args:
        study: one row per radius, from `radius_study`.
        chosen: radius to mark, metres.
    """
    from matplotlib.figure import Figure  # costs a second

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    radii = [row.radius for row in study]
    for label, value in _CURVES:
        values = np.array([value(row) for row in study]) * 1000
        if np.isfinite(values).any():
            axes.plot(radii, values, marker="o", markersize=4, label=label)
    if chosen is not None:
        axes.axvline(chosen, color="grey", linestyle="--", linewidth=1, label=f"{chosen:g} m")
    axes.set(xlabel="radius of the cylinders (m)", ylabel="millimetres", xticks=radii)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure
