import pytest
import torch
from dense_grid import DenseGrid, dense_convolution, dense_transposed_convolution

from nss_ros.registration.learned.sparse_convolution import (
    LIMIT,
    Convolution,
    PointwiseConvolution,
    SparseBatchNorm,
    Voxels,
    convolve,
    kernel_map,
    kernel_offsets,
    transposed,
)

# Half the edge of what is occupied, in voxels.
HALF = 6


def some_voxels(stride, seed=0):
    """Some voxels on both sides of the origin, in no order."""
    random = torch.Generator().manual_seed(seed)
    grid = torch.arange(-HALF, HALF) * stride
    everywhere = torch.cartesian_prod(grid, grid, grid)
    order = torch.randperm(len(everywhere), generator=random)
    return Voxels(everywhere[order[: len(everywhere) // 4]], stride)


def some_features(count, channels, seed=0):
    random = torch.Generator().manual_seed(seed)
    return torch.randn(count, channels, dtype=torch.float64, generator=random)


def some_kernel(size, inside, outside):
    return some_features(size**3 * inside, outside, 1).reshape(size**3, inside, outside)


def test_offsets_are_numbered_with_x_fastest():
    assert kernel_offsets(3)[:4].tolist() == [[-1, -1, -1], [0, -1, -1], [1, -1, -1], [-1, 0, -1]]
    assert kernel_offsets(3)[13].tolist() == [0, 0, 0]
    assert kernel_offsets(5)[25].tolist() == [-2, -2, -1]
    assert kernel_offsets(2)[:4].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 7])
@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("factor", [1, 2, 3])
def test_convolutions_are_those_of_a_dense_grid(size, stride, factor):
    fine = some_voxels(stride, size)
    coarse = fine if factor == 1 else fine.coarser(factor)
    grid = DenseGrid(-2 * HALF * stride, 4 * HALF * stride)
    mapped = kernel_map(fine, coarse, size)

    features, kernel = some_features(len(fine), 3), some_kernel(size, 3, 4)
    found = convolve(features, kernel, mapped)
    dense = dense_convolution(grid.filled(fine.coordinates, features, stride), kernel, factor)
    expected = grid.read(dense, coarse.coordinates, coarse.stride)
    assert torch.allclose(found, expected, atol=1e-12)
    assert found.abs().max() > 0.1

    features, kernel = some_features(len(coarse), 4), some_kernel(size, 4, 3)
    found = convolve(features, kernel, transposed(mapped, fine))
    filled = grid.filled(coarse.coordinates, features, coarse.stride)
    dense = dense_transposed_convolution(filled, kernel, factor)
    assert torch.allclose(found, grid.read(dense, fine.coordinates, stride), atol=1e-12)
    assert found.abs().max() > 0.1


def test_coarser_voxels_hold_the_finer_ones():
    voxels = Voxels(torch.tensor([[-1, 0, 7], [-8, 7, 0], [-9, 8, -1], [1000, -1000, 100_000]]))
    coarser = voxels.coarser(8)
    assert coarser.stride == 8
    expected = [[-16, 8, -8], [-8, 0, 0], [1000, -1000, 100_000]]
    assert coarser.coordinates.tolist() == expected
    again = voxels.coarser(2).coarser(4)
    assert torch.equal(again.coordinates, coarser.coordinates)
    assert again.stride == 8


def test_the_order_of_voxels_does_not_matter():
    voxels = some_voxels(1)
    features, kernel = some_features(len(voxels), 3), some_kernel(3, 3, 4)
    order = torch.randperm(len(voxels), generator=torch.Generator().manual_seed(3))
    other = Voxels(voxels.coordinates[order])
    found = convolve(features, kernel, kernel_map(voxels, voxels, 3))
    assert torch.equal(convolve(features[order], kernel, kernel_map(other, other, 3)), found[order])
    assert torch.equal(other.coarser(4).coordinates, voxels.coarser(4).coordinates)


def test_far_voxels():
    far = LIMIT - 10
    voxels = Voxels(torch.tensor([[far, -far, far], [far + 1, -far, far], [-far, far, -far]]))
    mapped = kernel_map(voxels, voxels, 3)
    found = {
        offset: sorted(zip(inputs.tolist(), outputs.tolist(), strict=True))
        for offset, (inputs, outputs) in enumerate(zip(mapped.inputs, mapped.outputs, strict=True))
        if len(inputs)
    }
    # One voxel further in x is the offset after the centre.
    assert found == {12: [(0, 1)], 13: [(0, 0), (1, 1), (2, 2)], 14: [(1, 0)]}
    with pytest.raises(ValueError, match="must be smaller"):
        kernel_map(voxels, voxels, 21)


@pytest.mark.parametrize("count", [0, 1])
def test_few_voxels(count):
    voxels = Voxels(torch.full((count, 3), -3))
    coarser = voxels.coarser(2)
    assert coarser.coordinates.tolist() == [[-4, -4, -4]] * count
    down = kernel_map(voxels, coarser, 3)
    convolution = Convolution(1, 2, 3)
    found = convolution(torch.ones(count, 1), down)
    # The voxel is the last of its coarser one's.
    assert torch.equal(found, convolution.kernel[26].expand(count, 2))
    back = Convolution(2, 1, 3)(found, transposed(down, voxels))
    assert back.shape == (count, 1)


def test_gradients():
    voxels = some_voxels(4)
    mapped = kernel_map(voxels, voxels.coarser(2), 3)
    features = some_features(len(voxels), 2).requires_grad_()
    kernel = some_kernel(3, 2, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, k: convolve(f, k, mapped), (features, kernel))


def test_modules_are_named_as_those_of_the_library():
    assert {n: tuple(p.shape) for n, p in Convolution(2, 4, 3).named_parameters()} == {
        "kernel": (27, 2, 4)
    }
    pointwise = PointwiseConvolution(2, 4, bias=True)
    assert {n: tuple(p.shape) for n, p in pointwise.named_parameters()} == {
        "kernel": (2, 4),
        "bias": (1, 4),
    }
    assert set(SparseBatchNorm(4).state_dict()) == {
        f"bn.{name}"
        for name in ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    }
    features = torch.randn(5, 2)
    assert torch.equal(pointwise(features), features @ pointwise.kernel + pointwise.bias)
