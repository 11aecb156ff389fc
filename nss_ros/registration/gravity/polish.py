"""Hypotheses moved nearby, to where the walls of both fragments lie on each other best.

What two fragments share may be a few walls, seen at a slant. An alignment of them that begins on
the cells of the search often ends a few decimetres and degrees beside the truth, or is carried away
and given up. So it begins anew from places around, and the end is taken where walls that face the
same way agree to the centimetre, the learned score is large and free space contradicts little.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RegistrationConfig
from nss_ros.geometry import Transform, from_yaw, inverse, relative, rotation_angle
from nss_ros.icp import Refined
from nss_ros.registration.fit import fit
from nss_ros.registration.gravity.agreement import agreement
from nss_ros.registration.gravity.refinement import Shape, coarsely, finely

# Places around, radians and metres.
_TURN, _SHIFT = np.radians(3), 0.2
# Farther away is another place; ends this near each other are one.
_MOST_TRANSLATION, _MOST_ROTATION = 0.6, np.radians(8)
_SAME_TRANSLATION, _SAME_ROTATION = 0.03, np.radians(0.5)
# What it counts, on the scale of the score, if all points fit, and if all are in free space. Of 171
# answers that were 0.2 to 0.6 m off these put 77 right, and of 490 that were right, but not sure,
# 14 wrong (the bundled bag, Schependomlaan, five maps of another simulator).
_FIT_WEIGHT, _FREE_WEIGHT, _FIT_DISTANCE = 150.0, 400.0, 0.1

Scores = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def polished(
    source: Shape, target: Shape, hypothesis: Refined, scores: Scores, config: RegistrationConfig
) -> Refined:
    """The best alignment near a hypothesis; the hypothesis where none is better.

    Args:
        source: of the pair.
        target: of the pair.
        hypothesis: aligned.
        scores: of transforms (k, 4, 4), by what was learned, (k,).
        config: settings.
    """
    known = [hypothesis.T_target_source]
    for start in _starts(hypothesis.T_target_source):
        end = coarsely(source.coarse, target.surface, start, config).T_target_source
        near = _is_within(end, hypothesis.T_target_source, _MOST_TRANSLATION, _MOST_ROTATION)
        if near and not any(_is_same(end, other) for other in known):
            known.append(end)
    if len(known) == 1:
        return hypothesis
    others = (finely(source.moderate, target.surface, end, config) for end in known[1:])
    found = [hypothesis, *others]
    transforms = np.array([each.T_target_source for each in found])
    worth = scores(transforms) + [_evidence(source, target, each) for each in transforms]
    return found[int(np.argmax(worth))]


def _starts(middle: Transform) -> list[Transform]:
    """The place itself, and those beside it."""
    starts = [middle]
    sides = ((_SHIFT, 0.0), (-_SHIFT, 0.0), (0.0, _SHIFT), (0.0, -_SHIFT))
    for turn, (x, y) in product((-_TURN, _TURN), sides):
        start = middle.copy()
        start[:3, :3] = from_yaw(turn, (0, 0, 0))[:3, :3] @ middle[:3, :3]
        start[:2, 3] += x, y
        starts.append(start)
    return starts


def _evidence(source: Shape, target: Shape, transform: Transform) -> float:
    there = fit(source.moderate, target.surface, transform, _FIT_DISTANCE)
    back = fit(target.moderate, source.surface, inverse(transform), _FIT_DISTANCE)
    free = agreement(source.view, target.view, transform).free
    return _FIT_WEIGHT * (there + back) - _FREE_WEIGHT * free


def _is_same(one: Transform, other: Transform) -> bool:
    return _is_within(one, other, _SAME_TRANSLATION, _SAME_ROTATION)


def _is_within(one: Transform, other: Transform, translation: float, rotation: float) -> bool:
    difference = relative(one, other)
    return bool(
        np.linalg.norm(difference[:3, 3]) < translation and rotation_angle(difference) < rotation
    )
