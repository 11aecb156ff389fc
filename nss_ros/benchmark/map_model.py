"""The 3-D view of a map in the report: few points, as whole numbers, for a script to unpack."""

from __future__ import annotations

from base64 import b64encode
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.benchmark.map_figures import limits
from nss_ros.benchmark.map_view import MapView, thinned
from nss_ros.colors import stage_hex

_STEPS = 2**16 - 1


def map_model(view: MapView, most: int) -> dict[str, Any]:
    """Points and spots by stage, ready for JSON.

    Coordinates are `origin + step * number`, metres; the numbers are little-endian uint16,
    x y z of one point after the other, in base64. What stands above `ceiling` is apart, since it
    hides the rest when seen from above.

    Args:
        view: with points.
        most: points at most.
    """
    low, high = limits(view.points.values())
    step = float((high - low).max() / _STEPS)
    ceiling = view.slice()[1]
    points = {
        stage: each[((each >= low) & (each <= high)).all(axis=1)]
        for stage, each in view.points.items()
    }
    stages = []
    for stage, each in thinned(points, most).items():
        numbers = np.rint((each - low) / step).clip(0, _STEPS).astype("<u2")
        above = each[:, 2] > ceiling
        spots = {id_: spot for id_, spot in view.spots.items() if id_.stage == stage}
        stages.append(
            {
                "stage": stage,
                "colour": stage_hex(stage),
                "below": _packed(numbers[~above]),
                "above": _packed(numbers[above]),
                "spots": [[str(id_), *(round(float(v), 3) for v in s)] for id_, s in spots.items()],
            }
        )
    return {
        "name": view.title,
        "origin": [float(value) for value in low],
        "step": step,
        "extent": [float(value) for value in high - low],
        "stages": stages,
    }


def _packed(numbers: NDArray[np.unsignedinteger[Any]]) -> str:
    return b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")
