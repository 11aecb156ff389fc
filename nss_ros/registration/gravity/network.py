"""The network that turns the maps of a fragment into feature maps that can be correlated.

The score of a pose is a sum over cells of products of source and target features: normals that
agree, learned descriptors that agree, surfaces that lie in free space (which counts against it).
So all poses of a grid are scored by correlation, and the network is trained on that very score.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nss_ros.registration.gravity.raster import FREE, LAYERS, NORMAL_X, OCCUPIED, SLICE_COUNT

#: Features are on cells twice as large as those of the maps.
STRIDE = 2
DESCRIPTORS = 12
CONFLICTS = 6
#: Channels: descriptors, the x and y of a normal for every slice, surfaces and free space.
CHANNELS = DESCRIPTORS + 2 * SLICE_COUNT + 2 * CONFLICTS
VECTORS = slice(DESCRIPTORS, DESCRIPTORS + 2 * SLICE_COUNT)


def as_target(features: Tensor) -> Tensor:
    """Features of a fragment as a target, from those as a source, (..., CHANNELS, h, w).

    A surface of the one in the free space of the other counts against a pose.
    """
    rest, surface, empty = torch.split(features, [VECTORS.stop, CONFLICTS, CONFLICTS], dim=-3)
    return torch.cat((rest, -empty, -surface), dim=-3)


class Block(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, inside: int, outside: int, stride: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(inside, outside, 3, stride, 1)
        self.first_norm = nn.GroupNorm(8, outside)
        self.second = nn.Conv2d(outside, outside, 3, 1, 1)
        self.second_norm = nn.GroupNorm(8, outside)
        self.shortcut = (
            nn.Identity()
            if stride == 1 and inside == outside
            else nn.Conv2d(inside, outside, 1, stride)
        )

    def forward(self, maps: Tensor) -> Tensor:
        """(b, inside, h, w) to (b, outside, h / stride, w / stride)."""
        hidden = torch.relu(self.first_norm(self.first(maps)))
        hidden = self.second_norm(self.second(hidden))
        return torch.relu(hidden + self.shortcut(maps))


class GravityNetwork(nn.Module):
    """A small U-Net with one head for pairs of one stage and one for pairs of different stages."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        inputs = SLICE_COUNT * LAYERS
        self.enter = Block(inputs, width, STRIDE)
        self.down = Block(width, 2 * width, 2)
        self.deep = Block(2 * width, 2 * width, 2)
        self.middle = Block(2 * width, 2 * width)
        self.rise = Block(4 * width, 2 * width)
        self.leave = Block(3 * width, width)
        self.heads = nn.ModuleList(Head(width) for _ in range(2))
        #: Logit of no overlap at all, for different stages and for one stage.
        self.absence = nn.Parameter(torch.zeros(2))

    def forward(self, maps: Tensor) -> Tensor:
        """Shared features (b, width, h / 2, w / 2) of maps (b, slices, layers, h, w)."""
        inputs = maps.flatten(1, 2)
        fine = self.enter(inputs)
        half = self.down(fine)
        quarter = self.middle(self.deep(half))
        half = self.rise(torch.cat((half, _larger(quarter)), dim=1))
        shared: Tensor = self.leave(torch.cat((fine, _larger(half)), dim=1))
        return shared

    def features(self, maps: Tensor, shared: Tensor, same_stage: bool) -> Tensor:
        """Features (b, CHANNELS, h / 2, w / 2), as a source, of maps and their shared features."""
        features: Tensor = self.heads[int(same_stage)](maps, shared)
        return features


class Head(nn.Module):
    """Descriptors, and how much each normal, surface and piece of free space counts."""

    def __init__(self, width: int) -> None:
        super().__init__()
        outputs = DESCRIPTORS + SLICE_COUNT + 2 * CONFLICTS
        self.outputs = nn.Conv2d(width, outputs, 1)
        nn.init.normal_(self.outputs.weight, std=0.02)
        self.outputs.bias.data.zero_()  # type: ignore[union-attr]
        slices = torch.eye(SLICE_COUNT)[:CONFLICTS]
        self.surface = nn.Parameter(slices.clone())
        self.empty = nn.Parameter(slices.clone())
        self.scale = nn.Parameter(torch.tensor([-1.0, -1.5]))

    def forward(self, maps: Tensor, shared: Tensor) -> Tensor:
        """Features as a source of maps (b, slices, layers, h, w) and shared features."""
        raw = nn.functional.avg_pool2d(maps.flatten(1, 2), STRIDE)
        raw = raw.reshape(len(raw), SLICE_COUNT, LAYERS, *raw.shape[2:])
        descriptors, gates, surface_gates, empty_gates = torch.split(
            self.outputs(shared), [DESCRIPTORS, SLICE_COUNT, CONFLICTS, CONFLICTS], dim=1
        )
        scale = self.scale.exp()
        gates = 2 * scale[0] * torch.sigmoid(gates)
        normals = 4 * raw[:, :, NORMAL_X : NORMAL_X + 2] * gates[:, :, None]
        surface = torch.einsum("ks,bshw->bkhw", self.surface, 4 * raw[:, :, OCCUPIED])
        empty = torch.einsum("ks,bshw->bkhw", self.empty, raw[:, :, FREE])
        surface = surface * 2 * scale[1] * torch.sigmoid(surface_gates)
        empty = empty * 2 * scale[1] * torch.sigmoid(empty_gates)
        vectors = normals.flatten(1, 2)
        return torch.cat((descriptors, vectors, surface, empty), dim=1)


def _larger(maps: Tensor) -> Tensor:
    return nn.functional.interpolate(maps, scale_factor=2.0, mode="nearest")
