"""Fragments, their ids, and pairs of them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nss_ros.errors import InputError

Points = NDArray[np.float32]

_TABLE_SIZE = 2**23

# Nine digits fit the uint32 of the messages.
_ID_PATTERN = re.compile(
    r"Bldg(?P<area>[A-Za-z0-9.-]+)_Stage(?P<stage>[0-9]{1,9})_Spot(?P<spot>[0-9]{1,9})"
)


@dataclass(frozen=True, order=True, slots=True)
class FragmentId:
    """Identity of a fragment, written `Bldg<area>_Stage<stage>_Spot<spot>` as in the NSS release.

    Ordered by area, stage and spot: the canonical order of every graph and table.
    """

    area: str
    stage: int
    spot: int

    @classmethod
    def parse(cls, text: str) -> FragmentId:
        """The id written as `text`, with or without a `.ply` ending.

        Raises:
            InputError: the text is not a fragment id.
        """
        match = _ID_PATTERN.fullmatch(text.removesuffix(".ply"))
        if match is None:
            raise InputError(
                f"'{text}' is not a fragment id: expected Bldg<area>_Stage<stage>_Spot<spot>, "
                "for example Bldg1_Stage2_Spot14."
            )
        return cls(match["area"], int(match["stage"]), int(match["spot"]))

    def __str__(self) -> str:
        return f"Bldg{self.area}_Stage{self.stage}_Spot{self.spot}"


@dataclass(frozen=True, order=True, slots=True)
class FragmentPair:
    """A request to find `T_target_source` of two fragments."""

    source: FragmentId
    target: FragmentId

    @property
    def same_stage(self) -> bool:
        """Whether both fragments are of one area and one stage."""
        return self.source.area == self.target.area and self.source.stage == self.target.stage

    def __str__(self) -> str:
        return f"{self.source} -> {self.target}"


@dataclass(frozen=True, slots=True)
class Fragment:
    """The partial point cloud of one tripod spot.

    Attributes:
        id: identity.
        points: (n, 3) float32, metres, sensor frame; finite.
        gravity_aligned: the sensor was levelled, z points up within about a degree.
    """

    id: FragmentId
    points: Points
    gravity_aligned: bool = False


def clean_points(points: ArrayLike) -> Points:
    """The finite points of an array, (n, 3) float32, contiguous.

    Raises:
        InputError: the array is not of shape (n, 3) or not of numbers.
    """
    try:
        array = np.asarray(points, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(f"A point cloud must be an array of numbers: {error}.") from error
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"A point cloud must be an array of shape (n, 3), not {array.shape}.")
    return np.ascontiguousarray(array[np.isfinite(array).all(axis=1)])


def voxelize(points: NDArray[np.floating], voxel_size: float) -> Points:
    """The mean point of every occupied voxel, (m, 3) float32, in a reproducible order.

    Args:
        points: (n, 3), metres.
        voxel_size: edge of the cubic voxels, metres; voxels lie on multiples of it.

    Raises:
        InputError: the voxel size is not positive.
    """
    voxels, count = occupied_voxels(points, voxel_size)
    return voxel_means(points, voxels, count)


def occupied_voxels(
    points: NDArray[np.floating], voxel_size: float
) -> tuple[NDArray[np.int64], int]:
    """In which occupied voxel each point lies, (n,) from 0, in order of x, y, z; and how many.

    Args:
        points: (n, 3), metres.
        voxel_size: edge of the cubic voxels, metres; voxels lie on multiples of it.

    Raises:
        InputError: the voxel size is not positive.
    """
    if voxel_size <= 0:
        raise InputError(f"A voxel size must be positive, not {voxel_size} m.")
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64), 0
    # Column by column: numpy is slow along short rows.
    floors = [np.floor(column / voxel_size) for column in points.T]
    lowest = [int(column.min()) for column in floors]
    extent = [int(column.max()) + 1 - low for column, low in zip(floors, lowest, strict=True)]
    size = math.prod(extent)
    if size >= 2**63:  # a point is far off
        unique, voxels = np.unique(np.stack(floors, axis=1), axis=0, return_inverse=True)
        return voxels.reshape(-1), len(unique)
    integer = np.int32 if max(map(abs, (size, *lowest))) < 2**31 else np.int64
    x, y, z = (column.astype(integer) - low for column, low in zip(floors, lowest, strict=True))
    keys = ((x * extent[1] + y) * extent[2] + z).astype(np.int64)
    if size > _TABLE_SIZE:
        unique, voxels = np.unique(keys, return_inverse=True)
        return voxels, len(unique)
    # Several times faster than sorting.
    occupied = np.zeros(size, dtype=bool)
    occupied[keys] = True
    found = np.flatnonzero(occupied)
    numbers = np.empty(size, dtype=np.int64)
    numbers[found] = np.arange(len(found))
    return numbers.take(keys), len(found)


def voxel_means(
    values: NDArray[np.floating], voxels: NDArray[np.int64], count: int
) -> NDArray[np.float32]:
    """Mean of the rows (n, k) in every voxel, (count, k) float32.

    Args:
        values: a row per point.
        voxels: (n,) voxel of each point, from 0.
        count: number of voxels; none is empty.
    """
    counts = np.bincount(voxels, minlength=count)
    sums = [np.bincount(voxels, column, minlength=count) for column in values.T]
    return np.asarray(np.stack(sums, axis=1) / counts[:, None], dtype=np.float32)
