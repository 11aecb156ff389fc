"""Maps of a levelled fragment from above: what stands where at which height, and what is empty.

The heights are measured from the floor of the fragment, so that tripods of different heights see
the same slices.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from nss_ros.registration.free_space import RangeImage

#: Limits of the slices above the floor, metres.
SLICES = (0.1, 0.5, 1.0, 1.5, 2.0, 2.5, 3.1, 4.2)
SLICE_COUNT = len(SLICES) - 1
#: Maps of every slice: mean normal in x and y, horizontal surface, surface of any kind, free.
LAYERS = 5
NORMAL_X, NORMAL_Y, HORIZONTAL, OCCUPIED, FREE = range(LAYERS)

CELL = 0.1
#: Cells along each side: 4.8 m to each side of the sensor, a little more than a Matterport sees.
SIZE = 96
# A cell of 0.1 x 0.1 x 0.5 m that a wall crosses holds about this many voxels of 0.075 m.
_FULL = 5.0
_FLOOR_BIN = 0.02
_FLOOR_NORMAL = 0.8
_FREE_HEIGHTS = (0.3, 0.7)

Array = NDArray[np.float64]
Raster = NDArray[np.float16]


@dataclass(frozen=True, slots=True)
class Floor:
    """Where the floor is.

    Attributes:
        height: z of it in the sensor frame, metres, negative.
        share: share of all points that lie on it; 0 when there is none and `height` is a guess.
    """

    height: float
    share: float


def find_floor(points: NDArray[np.floating], normals: NDArray[np.floating]) -> Floor:
    """The lowest of the large horizontal surfaces that face up, below the sensor.

    Args:
        points: (n, 3), metres, sensor frame, z up.
        normals: (n, 3), unit, towards the sensor.
    """
    heights = points[(normals[:, 2] > _FLOOR_NORMAL) & (points[:, 2] < -0.5), 2]
    if len(heights) < 20:
        lowest = float(np.percentile(points[:, 2], 2)) if len(points) else -1.6
        return Floor(min(lowest, -0.5), 0.0)
    low = float(heights.min()) - 5 * _FLOOR_BIN
    counts, edges = np.histogram(heights, np.arange(low, 0.0, _FLOOR_BIN))
    smooth = gaussian_filter1d(counts.astype(np.float64), 1.5)
    peak = int(np.flatnonzero(smooth >= 0.4 * smooth.max())[0])
    while peak + 1 < len(smooth) and smooth[peak + 1] > smooth[peak]:
        peak += 1
    centre = float(edges[peak] + _FLOOR_BIN / 2)
    near = np.abs(heights - centre) < 3 * _FLOOR_BIN
    return Floor(float(np.median(heights[near])), float(near.sum() / len(points)))


def rasterize(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    floor: float,
    size: int = SIZE,
) -> Raster:
    """The maps of a fragment, (slices, layers, size, size) float16; the sensor is in the middle.

    Rows count along y and columns along x, in cells of 0.1 m.

    Args:
        points: (n, 3), metres, sensor frame, z up.
        normals: (n, 3), unit, towards the sensor.
        floor: height of the floor in the sensor frame, metres.
        size: cells along each side.
    """
    above = points[:, 2] - floor
    height = np.searchsorted(SLICES, above, side="right") - 1
    columns = np.floor(points[:, 0] / CELL).astype(np.int64) + size // 2
    rows = np.floor(points[:, 1] / CELL).astype(np.int64) + size // 2
    inside = (height >= 0) & (height < SLICE_COUNT) & (np.hypot(*points[:, :2].T) < CELL * size / 2)
    shape = (SLICE_COUNT, size, size)
    cells = np.ravel_multi_index((height[inside], rows[inside], columns[inside]), shape)
    count = SLICE_COUNT * size * size
    kept = np.asarray(normals, dtype=np.float64)[inside]
    weights = (kept[:, 0], kept[:, 1], np.abs(kept[:, 2]), np.ones(len(kept)))
    maps = np.empty((SLICE_COUNT, LAYERS, size, size), dtype=np.float16)
    sums = [np.bincount(cells, weight, minlength=count).reshape(shape) for weight in weights]
    scale = np.minimum(sums[OCCUPIED] / _FULL, 1) / np.maximum(sums[OCCUPIED], 1)
    for layer, total in enumerate(sums):
        maps[:, layer] = total * scale
    maps[:, FREE] = _free(points, floor, size)
    return maps


def _free(points: NDArray[np.floating], floor: float, size: int) -> NDArray[np.float32]:
    """Share of the height of each cell that was seen to be empty, (slices, size, size)."""
    image = RangeImage.of(points)
    middle = (np.arange(size) - size // 2 + 0.5) * CELL
    x, y = np.meshgrid(middle, middle)
    free = np.zeros((SLICE_COUNT, size, size), dtype=np.float32)
    inside = np.hypot(x, y) < CELL * size / 2
    for number, (low, high) in enumerate(pairwise(SLICES)):
        for share in _FREE_HEIGHTS:
            z = np.full(x.shape, floor + low + share * (high - low))
            free[number] += image.empty(np.stack((x, y, z), axis=-1)) / len(_FREE_HEIGHTS)
    return np.asarray(free * inside)
