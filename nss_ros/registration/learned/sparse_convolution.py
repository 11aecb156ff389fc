"""Convolutions over the occupied voxels of a grid, as MinkowskiEngine numbers and aligns them.

Choy, Gwak, Savarese: 4D Spatio-Temporal ConvNets, CVPR 2019. Kernels trained by that library are
used as they are, so what it leaves to the implementation is done as it does it: offsets are
numbered with x fastest (`coordinate_at` in its src/kernel_region.hpp), an odd kernel is centred and
an even one begins at its voxel, a convolution correlates (nothing is flipped), voxels of a larger
stride lie at multiples of it (floor, so below zero too), and a transposed convolution uses the
pairs of the convolution that it undoes with their ends exchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Bits of a coordinate in the key of a voxel: one int64 holds three.
_BITS = 21
#: Coordinates of voxels are smaller than this, neighbours included.
LIMIT = 2 ** (_BITS - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Occupied voxels.

    Attributes:
        coordinates: (n, 3) int64, of x, y and z, in voxels of the finest grid; each once, and
            multiples of the stride.
        stride: edge of these voxels, in voxels of the finest grid.
    """

    coordinates: Tensor
    stride: int = 1

    def __len__(self) -> int:
        return len(self.coordinates)

    def coarser(self, factor: int) -> Voxels:
        """The voxels, larger by a factor, that hold these; ordered by x, y and z."""
        stride = factor * self.stride
        floors = torch.div(self.coordinates, stride, rounding_mode="floor")
        return Voxels(_coordinates(torch.unique(_keys(floors))) * stride, stride)


@dataclass(frozen=True, slots=True)
class KernelMap:
    """Which inputs a convolution adds to which outputs, for each offset of its kernel.

    Attributes:
        inputs: (m_k,) int64 of each offset k; none twice.
        outputs: (m_k,) int64 of each offset k; none twice.
        size: number of outputs.
    """

    inputs: list[Tensor]
    outputs: list[Tensor]
    size: int


def kernel_map(inputs: Voxels, outputs: Voxels, size: int) -> KernelMap:
    """The map of a convolution from voxels to the same or to larger ones.

    Args:
        inputs: offsets are in units of their stride.
        outputs: their stride is a multiple of that of the inputs.
        size: edge of the kernel, voxels.

    Raises:
        ValueError: a neighbour of a voxel lies outside of what keys can hold.
    """
    reach = (size + 1) * inputs.stride
    for voxels in (inputs, outputs):
        if len(voxels) and int(voxels.coordinates.abs().max()) + reach >= LIMIT:
            raise ValueError(f"Coordinates of voxels must be smaller than {LIMIT}.")
    same = inputs is outputs and size % 2 == 1
    shifts = _keys(kernel_offsets(size).to(inputs.coordinates.device) * inputs.stride)
    keys, order = torch.sort(_keys(inputs.coordinates))
    wanted = _keys(outputs.coordinates)
    if same:
        shifts = shifts[: size**3 // 2 + 1]
    pairs = [_pairs(keys, order, wanted + shift) for shift in shifts]
    if same:  # the rest are these, seen from the other end
        pairs += [(there, here) for here, there in reversed(pairs[:-1])]
    return KernelMap([here for here, _ in pairs], [there for _, there in pairs], len(outputs))


def transposed(forward: KernelMap, outputs: Voxels) -> KernelMap:
    """The map from the outputs of a map back to its inputs, which are these voxels."""
    return KernelMap(forward.outputs, forward.inputs, len(outputs))


def kernel_offsets(size: int) -> Tensor:
    """Offsets (size**3, 3) int64 of x, y and z in the order of a kernel's matrices."""
    steps = torch.arange(size) - (size // 2 if size % 2 else 0)
    z, y, x = torch.meshgrid(steps, steps, steps, indexing="ij")
    return torch.stack((x, y, z), dim=-1).reshape(-1, 3)


def convolve(features: Tensor, kernel: Tensor, mapped: KernelMap) -> Tensor:
    """Features (outputs, c') from features (inputs, c) by a kernel (offsets, c, c').

    Every row is added to once by each offset, and these follow each other: the sums are the same
    at every run, on a GPU too.
    """
    result = features.new_zeros(mapped.size, kernel.shape[2])
    for matrix, inputs, outputs in zip(kernel, mapped.inputs, mapped.outputs, strict=True):
        result.index_add_(0, outputs, features.index_select(0, inputs) @ matrix)
    return result


class Convolution(nn.Module):
    """A convolution without bias; what kind is said by the map.

    Attributes:
        kernel: (size**3, inside, outside).
    """

    def __init__(self, inside: int, outside: int, size: int) -> None:
        super().__init__()
        self.kernel = nn.Parameter(torch.empty(size**3, inside, outside))
        nn.init.normal_(self.kernel, std=(size**3 * inside) ** -0.5)

    def forward(self, features: Tensor, mapped: KernelMap) -> Tensor:
        """(inputs, inside) to (outputs, outside)."""
        return convolve(features, self.kernel, mapped)


class PointwiseConvolution(nn.Module):
    """A kernel of a single voxel.

    Attributes:
        kernel: (inside, outside).
        bias: (1, outside) or None.
    """

    def __init__(self, inside: int, outside: int, bias: bool) -> None:
        super().__init__()
        self.kernel = nn.Parameter(torch.empty(inside, outside))
        nn.init.normal_(self.kernel, std=inside**-0.5)
        self.bias = nn.Parameter(torch.zeros(1, outside)) if bias else None

    def forward(self, features: Tensor) -> Tensor:
        """(n, inside) to (n, outside)."""
        result = features @ self.kernel
        return result if self.bias is None else result + self.bias


class SparseBatchNorm(nn.Module):
    """Batch normalisation over voxels.

    Attributes:
        bn: of features (n, channels).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bn = nn.BatchNorm1d(channels)

    def forward(self, features: Tensor) -> Tensor:
        """(n, channels) to the same."""
        result: Tensor = self.bn(features)
        return result


def _keys(coordinates: Tensor) -> Tensor:
    """One number (n,) int64 for each of coordinates (n, 3), in their order; shifts add to it."""
    x, y, z = coordinates.unbind(dim=1)
    return (x << 2 * _BITS) + (y << _BITS) + z


def _coordinates(keys: Tensor) -> Tensor:
    """Coordinates (n, 3) of keys."""
    columns = []
    for _ in range(2):
        low = ((keys + LIMIT) & (2 * LIMIT - 1)) - LIMIT
        columns.append(low)
        keys = (keys - low) >> _BITS
    return torch.stack((keys, *reversed(columns)), dim=1)


def _pairs(keys: Tensor, order: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Inputs whose keys are wanted, and by which outputs, each (m,).

    Args:
        keys: (n,), ascending.
        order: (n,) input of each key.
        wanted: (k,) one per output.
    """
    if len(keys) == 0:
        return order, order
    places = torch.searchsorted(keys, wanted).clamp_(max=len(keys) - 1)
    outputs = torch.nonzero(keys[places] == wanted).squeeze(1)
    return order[places[outputs]], outputs
