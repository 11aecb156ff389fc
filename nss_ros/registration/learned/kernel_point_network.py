"""The U-Net of kernel point convolutions that D3Feat and Predator share.

Blocks and their tensors are named as in the authors' checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nss_ros.registration.learned.kernel_points import KernelPointConvolution, max_pooled
from nss_ros.registration.learned.pyramid import Level

#: Radius of neighbourhoods, in voxels of their level.
RADIUS = 2.5
#: Channels of the finest level; twice as many on each next one.
WIDTH = 128
#: Most neighbours of a point, of each level. The authors take what four of five points of their
#: training data stay below; these are the figures for 3DMatch of the demo of GeoTransformer, whose
#: pyramid has the same voxels and radii. The fifth goes on from the fourth.
LIMITS = (38, 36, 36, 38, 38)

# Distance at which a kernel point loses its influence, in voxels.
_EXTENT = 2.0
_SLOPE = 0.1


@dataclass(frozen=True, slots=True)
class Recipe:
    """In what networks of this kind differ.

    Attributes:
        normalisation: makes the layer (n, c) to (n, c) that follows a convolution, for c channels.
        biased: unary layers have a bias of their own.
        voxel_size: of the finest level, metres.
        depth: number of levels.
    """

    normalisation: Callable[[int], nn.Module]
    biased: bool
    voxel_size: float
    depth: int

    def convolution(self, inside: int, outside: int, depth: int) -> KernelPointConvolution:
        """A convolution on a level."""
        voxel_size = 2**depth * self.voxel_size
        return KernelPointConvolution(inside, outside, RADIUS * voxel_size, _EXTENT * voxel_size)


class KernelPointNetwork(nn.Module):
    """An encoder, and a decoder that ends on the finest level."""

    def __init__(self, recipe: Recipe, inside: int, outside: int) -> None:
        """A decoder of `inside` channels on the coarsest level, `outside` on the finest."""
        super().__init__()
        self.encoder_blocks = nn.ModuleList(_encoder(recipe))
        self.decoder_blocks = nn.ModuleList(_decoder(recipe, inside, outside))

    def encoded(self, features: Tensor, levels: Sequence[Level]) -> tuple[Tensor, list[Tensor]]:
        """Features of the coarsest level, and of the others, the finest first."""
        kept = []
        for block in self.encoder_blocks:
            if isinstance(block, Residual) and block.strided:
                kept.append(features)
            features = block(features, levels)
        return features, kept

    def decoded(self, features: Tensor, kept: list[Tensor], levels: Sequence[Level]) -> Tensor:
        """Features of the finest level, by those of the coarsest and by what was kept."""
        unaries = self.decoder_blocks[1::2]  # between them stands what raises the features
        for unary, level, beside in zip(unaries, levels[-2::-1], kept[::-1], strict=True):
            features = unary(torch.cat((features[level.upsampling], beside), dim=1))
        return features


def _encoder(recipe: Recipe) -> list[nn.Module]:
    blocks: list[nn.Module] = [Simple(recipe, 1, WIDTH // 2), Residual(recipe, WIDTH // 2, WIDTH)]
    for depth in range(1, recipe.depth):
        width = 2**depth * WIDTH
        blocks.append(Residual(recipe, width // 2, width // 2, depth - 1, strided=True))
        blocks.append(Residual(recipe, width // 2, width, depth))
        blocks.append(Residual(recipe, width, width, depth))
    return blocks


def _decoder(recipe: Recipe, inside: int, outside: int) -> list[nn.Module]:
    """A place without tensors and a unary layer per level, the coarser first."""
    blocks: list[nn.Module] = []
    for depth in range(recipe.depth - 2, -1, -1):
        width = inside // 2
        joined = inside + 2**depth * WIDTH
        last = depth == 0
        layer = Linear(joined, outside, recipe) if last else Unary(recipe, joined, width)
        blocks += [nn.Identity(), layer]
        inside = width
    return blocks


class Linear(nn.Module):
    """A linear layer by its official name."""

    def __init__(self, inside: int, outside: int, recipe: Recipe) -> None:
        super().__init__()
        self.mlp = nn.Linear(inside, outside, bias=recipe.biased)
        if recipe.biased:  # what a checkpoint without biases means
            nn.init.zeros_(self.mlp.bias)

    def forward(self, features: Tensor) -> Tensor:
        """(n, inside) to (n, outside)."""
        mapped: Tensor = self.mlp(features)
        return mapped


class Unary(Linear):
    """A linear layer, normalised and, unless it is to be added to another, activated."""

    def __init__(self, recipe: Recipe, inside: int, outside: int, activated: bool = True) -> None:
        super().__init__(inside, outside, recipe)
        self.batch_norm = recipe.normalisation(outside)
        self.activated = activated

    def forward(self, features: Tensor) -> Tensor:
        """(n, inside) to (n, outside)."""
        features = self.batch_norm(self.mlp(features))
        return activation(features) if self.activated else features


class Simple(nn.Module):
    """A convolution on the finest level."""

    def __init__(self, recipe: Recipe, inside: int, outside: int) -> None:
        super().__init__()
        self.KPConv = recipe.convolution(inside, outside, 0)
        self.batch_norm = recipe.normalisation(outside)

    def forward(self, features: Tensor, levels: Sequence[Level]) -> Tensor:
        """(n, inside) to (n, outside)."""
        points, neighbours = levels[0].points, levels[0].neighbours
        return activation(self.batch_norm(self.KPConv(points, points, neighbours, features)))


class Residual(nn.Module):
    """A convolution of a quarter of the channels, beside a shortcut.

    Attributes:
        depth: level of its input.
        strided: its output is on the next level.
    """

    def __init__(
        self, recipe: Recipe, inside: int, outside: int, depth: int = 0, strided: bool = False
    ) -> None:
        super().__init__()
        self.depth = depth
        self.strided = strided
        narrow = outside // 4
        self.unary1 = nn.Identity() if inside == narrow else Unary(recipe, inside, narrow)
        self.KPConv = recipe.convolution(narrow, narrow, depth)
        self.batch_norm_conv = recipe.normalisation(narrow)
        self.unary2 = Unary(recipe, narrow, outside, activated=False)
        self.unary_shortcut = (
            nn.Identity() if inside == outside else Unary(recipe, inside, outside, activated=False)
        )

    def forward(self, features: Tensor, levels: Sequence[Level]) -> Tensor:
        """(n, inside) to (m, outside); m is n, or the points of the next level."""
        level = levels[self.depth]
        queries, neighbours, shortcut = level.points, level.neighbours, features
        if self.strided:
            if level.pooling is None:
                raise ValueError("The pyramid has too few levels for the network.")
            queries, neighbours = levels[self.depth + 1].points, level.pooling
            shortcut = max_pooled(features, neighbours)
        hidden = self.KPConv(queries, level.points, neighbours, self.unary1(features))
        hidden = self.unary2(activation(self.batch_norm_conv(hidden)))
        return activation(hidden + self.unary_shortcut(shortcut))


def activation(features: Tensor) -> Tensor:
    """The leaky ReLU of all layers."""
    return nn.functional.leaky_relu(features, _SLOPE)
