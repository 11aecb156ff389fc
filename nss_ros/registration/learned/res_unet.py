"""The network of FCGF: a sparse U-Net with residual blocks (Choy, Park, Koltun, ICCV 2019).

It is what its authors call ResUNetBN2C. Modules and parameters are named as in their checkpoints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from nss_ros.registration.learned.sparse_convolution import (
    Convolution,
    KernelMap,
    PointwiseConvolution,
    SparseBatchNorm,
    Voxels,
    kernel_map,
    transposed,
)

#: Voxels of the coarsest level are larger by this.
LARGEST_STRIDE = 8
_LEVELS = 4
_DOWN = (32, 64, 128, 256)
_UP = (64, 64, 64, 128)


@dataclass(frozen=True, slots=True)
class Pyramid:
    """The maps of all convolutions over the voxels of one fragment.

    Attributes:
        first: of the first convolution, whose kernel is larger.
        within: within each of four levels, finest first.
        down: from each level to the next.
        up: back to each level from the next.
    """

    first: KernelMap
    within: list[KernelMap]
    down: list[KernelMap]
    up: list[KernelMap]

    @classmethod
    def of(cls, voxels: Voxels, first_size: int) -> Pyramid:
        """Maps over voxels of stride 1 for a first kernel of some size.

        Raises:
            ValueError: a voxel is too far off; see `sparse_convolution.LIMIT`.
        """
        levels = [voxels]
        while len(levels) < _LEVELS:
            levels.append(levels[-1].coarser(2))
        within = [kernel_map(level, level, 3) for level in levels]
        down = [kernel_map(fine, coarse, 3) for fine, coarse in pairwise(levels)]
        up = [transposed(each, level) for each, level in zip(down, levels, strict=False)]
        return cls(kernel_map(voxels, voxels, first_size), within, down, up)


def sizes(tensors: Mapping[str, Tensor]) -> tuple[int, int]:
    """Width of descriptors and edge of the first kernel of the network that tensors are of."""
    outputs, first = tensors.get("final.bias"), tensors.get("conv1.kernel")
    width = 32 if outputs is None else max(outputs.numel(), 1)
    volume = 5**3 if first is None else max(first.numel() // _DOWN[0], 1)
    return width, round(volume ** (1 / 3))


class ResUNet(nn.Module):
    """Describes voxels.

    Attributes:
        width: of descriptors.
        first_size: edge of the first kernel, voxels.
    """

    def __init__(self, width: int, first_size: int) -> None:
        super().__init__()
        self.width = width
        self.first_size = first_size
        self.conv1 = Convolution(1, _DOWN[0], first_size)
        self.norm1 = SparseBatchNorm(_DOWN[0])
        self.block1 = ResidualBlock(_DOWN[0])
        self.conv2 = Convolution(_DOWN[0], _DOWN[1], 3)
        self.norm2 = SparseBatchNorm(_DOWN[1])
        self.block2 = ResidualBlock(_DOWN[1])
        self.conv3 = Convolution(_DOWN[1], _DOWN[2], 3)
        self.norm3 = SparseBatchNorm(_DOWN[2])
        self.block3 = ResidualBlock(_DOWN[2])
        self.conv4 = Convolution(_DOWN[2], _DOWN[3], 3)
        self.norm4 = SparseBatchNorm(_DOWN[3])
        self.block4 = ResidualBlock(_DOWN[3])
        self.conv4_tr = Convolution(_DOWN[3], _UP[3], 3)
        self.norm4_tr = SparseBatchNorm(_UP[3])
        self.block4_tr = ResidualBlock(_UP[3])
        self.conv3_tr = Convolution(_DOWN[2] + _UP[3], _UP[2], 3)
        self.norm3_tr = SparseBatchNorm(_UP[2])
        self.block3_tr = ResidualBlock(_UP[2])
        self.conv2_tr = Convolution(_DOWN[1] + _UP[2], _UP[1], 3)
        self.norm2_tr = SparseBatchNorm(_UP[1])
        self.block2_tr = ResidualBlock(_UP[1])
        self.conv1_tr = PointwiseConvolution(_DOWN[0] + _UP[1], _UP[0], bias=False)
        self.final = PointwiseConvolution(_UP[0], width, bias=True)

    def forward(self, features: Tensor, pyramid: Pyramid) -> Tensor:
        """Unit descriptors (n, width) of voxels with features (n, 1)."""
        one = self.norm1(self.conv1(features, pyramid.first))
        one = self.block1(one, pyramid.within[0])
        two = self.norm2(self.conv2(one, pyramid.down[0]))
        two = self.block2(two, pyramid.within[1])
        four = self.norm3(self.conv3(two, pyramid.down[1]))
        four = self.block3(four, pyramid.within[2])
        eight = self.norm4(self.conv4(four, pyramid.down[2]))
        eight = self.block4(eight, pyramid.within[3])
        up = self.norm4_tr(self.conv4_tr(eight, pyramid.up[2]))
        up = self.block4_tr(up, pyramid.within[2])
        up = self.norm3_tr(self.conv3_tr(torch.cat((up, four), dim=1), pyramid.up[1]))
        up = self.block3_tr(up, pyramid.within[1])
        up = self.norm2_tr(self.conv2_tr(torch.cat((up, two), dim=1), pyramid.up[0]))
        up = self.block2_tr(up, pyramid.within[0])
        up = torch.relu(self.conv1_tr(torch.cat((up, one), dim=1)))
        return nn.functional.normalize(self.final(up))


class ResidualBlock(nn.Module):
    """Two convolutions that are added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = Convolution(channels, channels, 3)
        self.norm1 = SparseBatchNorm(channels)
        self.conv2 = Convolution(channels, channels, 3)
        self.norm2 = SparseBatchNorm(channels)

    def forward(self, features: Tensor, mapped: KernelMap) -> Tensor:
        """(n, channels) to the same."""
        hidden = torch.relu(self.norm1(self.conv1(features, mapped)))
        hidden = self.norm2(self.conv2(hidden, mapped))
        return torch.relu(hidden + features)
