"""Features of many placed fragments on one canvas, and the poses of one canvas on another.

A fragment alone is often ambiguous; what several of them saw together hardly is. The score of a
pose is linear in the features of the network, so those of fragments that are placed in one frame
are averaged cell by cell, and a canvas is then compared with another as two fragments are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, from_yaw, inverse
from nss_ros.registration.gravity.coarse import (
    COARSE_YAWS,
    POOL,
    coarse_scores,
    pooled,
    shift_of_middles,
)
from nss_ros.registration.gravity.correlation import STEP, rotated
from nss_ros.registration.gravity.network import CHANNELS, VECTORS, as_target
from nss_ros.registration.gravity.search import best_places

# The weight of what the network says of cells that a fragment did not see.
_UNSEEN = 0.05
# At the rims of the fragments nothing is made larger than it was.
_LEAST_SEEN = 0.05
# Poses that score less than the best one by this, on the cells of the search, are not told.
_MOST_MARGIN = 10.0

Poses = Mapping[FragmentId, Transform]


class Mapped(Protocol):
    """A fragment that can be put on a canvas."""

    @property
    def maps(self) -> NDArray[np.float16]:
        """(2, CHANNELS, h, w), features for a pair of different stages and of one."""
        ...

    @property
    def seen(self) -> NDArray[np.float16]:
        """(h, w), 0..1, how much of each cell its scanner saw."""
        ...


@dataclass(frozen=True, slots=True)
class Layer:
    """Sums over the fragments of one stage.

    Attributes:
        across: (CHANNELS, n, n), of features for pairs of different stages.
        within: (CHANNELS, n, n), of features for pairs of one stage.
        seen: (n, n), how many fragments saw a cell; what is not seen counts little.
    """

    across: Tensor
    within: Tensor
    seen: Tensor

    @classmethod
    def blank(cls, size: int) -> Layer:
        """A layer without fragments."""
        features = torch.zeros(CHANNELS, size, size)
        return cls(features, features.clone(), torch.zeros(size, size))

    def mean_across(self) -> Tensor:
        """Features for pairs of different stages."""
        return self.across / self.seen.clamp(min=_LEAST_SEEN)

    def mean_within(self) -> Tensor:
        """Features for pairs of one stage."""
        return self.within / self.seen.clamp(min=_LEAST_SEEN)

    def padded(self, rim: int) -> Layer:
        """A copy with `rim` more cells on each side."""
        across, within, seen = (
            torch.nn.functional.pad(each, (rim, rim, rim, rim))
            for each in (self.across, self.within, self.seen)
        )
        return Layer(across, within, seen)


@dataclass(frozen=True, slots=True)
class Canvas:
    """Features of placed fragments on a square grid along the axes of their frame.

    Attributes:
        centre: (2,) float64, x and y of its middle, metres.
        layers: by stage.
        features: (CHANNELS, n, n), the mean of all fragments, for pairs of different stages.
    """

    centre: NDArray[np.float64]
    layers: Mapping[int, Layer]
    features: Tensor

    @property
    def size(self) -> int:
        """Cells along each side."""
        return int(self.features.shape[-1])

    @classmethod
    def of(cls, poses: Poses, fragments: Mapping[FragmentId, Mapped]) -> Canvas:
        """The canvas of fragments with poses in one frame, all prepared."""
        places = np.array([pose[:2, 3] for pose in poses.values()])
        low, high = places.min(axis=0), places.max(axis=0)
        return cls._with((low + high) / 2, {}, poses, fragments)

    def extended(self, poses: Poses, fragments: Mapping[FragmentId, Mapped]) -> Canvas:
        """This canvas with further fragments in the same frame."""
        return self._with(self.centre, self.layers, poses, fragments)

    @classmethod
    def _with(
        cls,
        centre: NDArray[np.float64],
        layers: Mapping[int, Layer],
        poses: Poses,
        fragments: Mapping[FragmentId, Mapped],
    ) -> Canvas:
        reach = max(
            float(np.abs(pose[:2, 3] - centre).max()) + _window(fragments[id_]) * STEP / 2
            for id_, pose in poses.items()
        )
        with torch.inference_mode():
            size = 2 * math.ceil(reach / STEP)
            old = max((each.seen.shape[-1] for each in layers.values()), default=0)
            size = max(size, old)
            new = {stage: each.padded((size - old) // 2) for stage, each in layers.items()}
            for id_, pose in poses.items():
                layer = new.setdefault(id_.stage, Layer.blank(size))
                _add(layer, fragments[id_], pose, centre)
            across = torch.stack([each.across for each in new.values()]).sum(dim=0)
            seen = torch.stack([each.seen for each in new.values()]).sum(dim=0)
            return cls(centre, new, across / seen.clamp(min=_LEAST_SEEN))


def _window(fragment: Mapped) -> int:
    """Cells of its features along each side, and one more on each, for it is not on the grid."""
    return int(fragment.seen.shape[-1]) + 2


def _add(layer: Layer, fragment: Mapped, pose: Transform, centre: NDArray[np.float64]) -> None:
    """Add the features of a fragment to a layer, in place."""
    size, window = layer.seen.shape[-1], _window(fragment)
    cell = (pose[:2, 3] - centre) / STEP + size / 2
    start = np.round(cell - window / 2).astype(int).clip(0, size - window)
    shift = torch.from_numpy((cell - start - window / 2) * STEP).float()[None]
    yaw = torch.tensor([math.atan2(pose[1, 0], pose[0, 0])], dtype=torch.float32)
    weight = torch.from_numpy(fragment.seen.astype(np.float32)).clamp(min=_UNSEEN)
    columns, rows = (slice(int(first), int(first) + window) for first in start)
    for sums, features in zip((layer.across, layer.within), fragment.maps, strict=True):
        weighted = torch.from_numpy(features.astype(np.float32)) * weight
        sums[:, rows, columns] += rotated(weighted, yaw, shift, window)[0]
    everywhere = weight.expand(CHANNELS, *weight.shape)
    layer.seen[rows, columns] += rotated(everywhere, yaw, shift, window)[0, 0]


def canvas_score(source: Canvas, target: Canvas, T_target_source: Transform) -> float:
    """Logarithm of the probability density of a pose, up to a constant.

    What both saw in one stage is compared as fragments of one stage are. Of what they saw in
    different stages counts the mean, or those two stages that agree most: where a building changed
    much, only its next stage still looks like it. Faster when the source is the smaller one.
    """
    with torch.inference_mode():
        place = _Place.of(source, target, T_target_source)
        size = source.size
        score = _product(source.features, place.there(target.features, size))
        if len(source.layers) * len(target.layers) > 1:
            score = max(score, _best_of_stages(source, target, place))
        for stage in sorted(source.layers.keys() & target.layers.keys()):
            one, other = source.layers[stage], target.layers[stage]
            for features, sign in ((Layer.mean_within, 1), (Layer.mean_across, -1)):
                there = place.there(_agreeing(features(other)), size)
                score += sign * _product(_agreeing(features(one)), there)
        return score


def _best_of_stages(source: Canvas, target: Canvas, place: _Place) -> float:
    """The largest score of two different stages, one of each canvas."""
    scores = [-math.inf]
    for stage, layer in target.layers.items():
        there = place.there(layer.mean_across(), source.size)
        scores += [
            _product(own.mean_across(), there)
            for other, own in source.layers.items()
            if other != stage
        ]
    return max(scores)


def _agreeing(features: Tensor) -> Tensor:
    """Without surfaces and free space.

    Within a stage, walls seen from both sides share the cells of the canvas with the free space
    of the other room, and the more fragments there are, the more. `Submap` looks closer.
    """
    return torch.cat((features[: VECTORS.stop], torch.zeros_like(features[VECTORS.stop :])))


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the cells of a source are on its target.

    Attributes:
        yaw: (1,) of `T_source_target`.
        shift: (1, 2) metres, of the target's middle from the source's.
    """

    yaw: Tensor
    shift: Tensor

    @classmethod
    def of(cls, source: Canvas, target: Canvas, T_target_source: Transform) -> _Place:
        back = inverse(T_target_source)
        shift = back[:2, :2] @ target.centre + back[:2, 3] - source.centre
        yaw = torch.tensor([math.atan2(back[1, 0], back[0, 0])], dtype=torch.float32)
        return cls(yaw, torch.from_numpy(shift[None]).float())

    def there(self, still: Tensor, size: int) -> Tensor:
        """Features of the target, as a source, where they are on a source of so many cells."""
        return rotated(still, self.yaw, self.shift, size)[0]


def _product(moving: Tensor, there: Tensor) -> float:
    """Sum of the products of source features and target features, both as sources."""
    return float((moving * as_target(there)).sum())


def canvas_search(source: Canvas, target: Canvas, count: int) -> list[Transform]:
    """The best `T_target_source`, all with z = 0, best first.

    Args:
        source: what is turned; faster when it is the smaller one.
        target: the other.
        count: most poses; fewer where the others are far less probable.
    """
    with torch.inference_mode():
        moving, still = (pooled(each) for each in _searched(source, target))
        scores = coarse_scores(moving, still)
    sizes = moving.shape[-1], still.shape[-1], scores.shape[-1]
    places = best_places(scores, count)
    transforms = []
    for place in places:
        if place.score < places[0].score - _MOST_MARGIN:
            break
        yaw, cells = place.cells[0] * 2 * math.pi / COARSE_YAWS, place.cells[:0:-1]
        shift = shift_of_middles(cells, *sizes)
        transform = from_yaw(yaw, (0.0, 0.0, 0.0))
        middle = target.centre + shift * STEP * POOL
        transform[:2, 3] = middle - transform[:2, :2] @ source.centre
        transforms.append(transform)
    return transforms


def _searched(source: Canvas, target: Canvas) -> tuple[Tensor, Tensor]:
    """The features by which a search goes: of one stage where there is only that."""
    if len(source.layers) > 1 or source.layers.keys() != target.layers.keys():
        return source.features, target.features
    (stage,) = source.layers
    one, other = source.layers[stage], target.layers[stage]
    return one.within / one.seen.clamp(min=_LEAST_SEEN), other.within / other.seen.clamp(
        min=_LEAST_SEEN
    )
