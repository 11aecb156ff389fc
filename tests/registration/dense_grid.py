"""Sparse features on a dense grid, and the kernels of MinkowskiEngine as PyTorch has them."""

import torch


class DenseGrid:
    """A grid of voxels that begins at a voxel and has an edge, both in voxels of stride 1."""

    def __init__(self, lowest, edge):
        self.lowest = lowest
        self.edge = edge

    def index(self, coordinates, stride):
        return tuple(((coordinates - self.lowest) // stride).T)

    def filled(self, coordinates, features, stride):
        """(1, c, n, n, n) with features (m, c) at coordinates (m, 3), zero elsewhere."""
        edge = self.edge // stride
        grid = features.new_zeros(edge, edge, edge, features.shape[1])
        grid[self.index(coordinates, stride)] = features
        return grid.permute(3, 0, 1, 2)[None]

    def read(self, grid, coordinates, stride):
        """Features (m, c) of a grid (1, c, n, n, n) at coordinates (m, 3)."""
        return grid[0].permute(1, 2, 3, 0)[self.index(coordinates, stride)]


def before(size):
    """Voxels of a kernel that lie before its own: an odd one is centred."""
    return size // 2 if size % 2 else 0


def cube(kernel):
    """A kernel (size**3, in, out), x fastest, as (in, out, x, y, z)."""
    size = round(kernel.shape[0] ** (1 / 3))
    return kernel.reshape(size, size, size, *kernel.shape[1:]).permute(3, 4, 2, 1, 0)


def dense_convolution(grid, kernel, factor):
    weight = cube(kernel).transpose(0, 1)
    size = weight.shape[-1]
    padding = [before(size), size - 1 - before(size)] * 3
    padded = torch.nn.functional.pad(grid, padding)
    return torch.nn.functional.conv3d(padded, weight, stride=factor)


def dense_transposed_convolution(grid, kernel, factor):
    weight = cube(kernel)
    size, edge = weight.shape[-1], factor * grid.shape[-1]
    result = torch.nn.functional.conv_transpose3d(grid, weight, stride=factor)
    result = torch.nn.functional.pad(
        result, [0, max(0, edge + before(size) - result.shape[-1])] * 3
    )
    kept = slice(before(size), before(size) + edge)
    return result[..., kept, kept, kept]
