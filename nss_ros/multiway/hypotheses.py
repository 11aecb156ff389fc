"""Which hypothesis of an ambiguous pair a map supports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nss_ros.geometry import Transform, inverse, rotation_angle
from nss_ros.multiway.pose_graph import Alternative, Measurement
from nss_ros.multiway.spanning_tree import Closeness


def fitting_hypothesis(
    m: Measurement, T_target_source: Transform, close: Closeness
) -> Measurement | None:
    """The measurement with the hypothesis that is nearest to a transform; None if none is close.

    Args:
        m: with its alternatives.
        T_target_source: of the map.
        close: when a hypothesis agrees with it.
    """
    first = Alternative(m.T_target_source, m.information, m.confidence)
    hypotheses = (first, *m.alternatives)
    stack = np.array([each.T_target_source for each in hypotheses])
    fitting = np.flatnonzero(close.agree(T_target_source, stack))
    if not len(fitting):
        return None
    nearest = min(
        (hypotheses[n] for n in fitting),
        key=lambda each: _misfit(each.T_target_source, T_target_source, close),
    )
    return replace(
        m,
        T_target_source=nearest.T_target_source,
        information=nearest.information,
        confidence=nearest.probability,
        alternatives=(),
    )


def _misfit(hypothesis: Transform, T_target_source: Transform, close: Closeness) -> float:
    error = inverse(hypothesis) @ T_target_source
    distance = float(np.linalg.norm(error[:3, 3]))
    return distance / close.translation + rotation_angle(error) / close.rotation
