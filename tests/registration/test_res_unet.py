import numpy as np
import pytest
import torch
from dense_grid import DenseGrid, dense_convolution, dense_transposed_convolution
from furnished_room import room

from nss_ros.registration.learned.res_unet import LARGEST_STRIDE, Pyramid, ResUNet, sizes
from nss_ros.registration.learned.sparse_convolution import Voxels


def random_network(width=16, first_size=5):
    """A network with weights and statistics at random, ready for use."""
    random = torch.Generator().manual_seed(0)
    network = ResUNet(width, first_size).double()
    for name, tensor in network.state_dict().items():
        if name.endswith((".bn.weight", ".running_var")):
            tensor.copy_(torch.rand(tensor.shape, generator=random) + 0.5)
        elif tensor.is_floating_point():
            scale = 0.2 if tensor.dim() == 1 else (tensor.numel() / tensor.shape[-1]) ** -0.5
            tensor.copy_(scale * torch.randn(tensor.shape, generator=random))
    return network.eval()


def room_voxels(size=0.2):
    voxels = np.unique(np.floor(room() / size).astype(np.int64), axis=0)
    return torch.from_numpy(voxels)


@torch.inference_mode()
def described(network, coordinates):
    voxels = Voxels(coordinates)
    occupied = torch.ones(len(voxels), 1, dtype=torch.float64)
    return network(occupied, Pyramid.of(voxels, network.first_size))


class DenseReference:
    """The network on a dense grid, by the names of its tensors; empty voxels are kept at zero."""

    def __init__(self, tensors, grid, coordinates):
        self.tensors = tensors
        self.levels = [coordinates]
        for stride in (2, 4, 8):
            self.levels.append(torch.unique(coordinates.div(stride, rounding_mode="floor"), dim=0))
            self.levels[-1] *= stride
        self.occupied = [
            grid.filled(each, torch.ones(len(each), 1, dtype=torch.float64), 2**level)
            for level, each in enumerate(self.levels)
        ]
        self.grid = grid

    def normalised(self, name, features, level):
        mean, variance, weight, bias = (
            self.tensors[f"{name}.bn.{part}"][:, None, None, None]
            for part in ("running_mean", "running_var", "weight", "bias")
        )
        return ((features - mean) / (variance + 1e-5).sqrt() * weight + bias) * self.occupied[level]

    def convolved(self, number, features, level, factor=1, prefix=""):
        kernel = self.tensors[f"{prefix}conv{number}.kernel"]
        features = dense_convolution(features, kernel, factor)
        return self.normalised(f"{prefix}norm{number}", features, level)

    def block(self, name, features, level):
        hidden = self.convolved(1, features, level, prefix=f"{name}.").relu()
        return (self.convolved(2, hidden, level, prefix=f"{name}.") + features).relu()

    def raised(self, number, features, level):
        kernel = self.tensors[f"conv{number}_tr.kernel"]
        features = dense_transposed_convolution(features, kernel, 2)
        features = self.normalised(f"norm{number}_tr", features, level)
        return self.block(f"block{number}_tr", features, level)

    def descriptors(self):
        one = self.block("block1", self.convolved(1, self.occupied[0], 0), 0)
        two = self.block("block2", self.convolved(2, one, 1, 2), 1)
        four = self.block("block3", self.convolved(3, two, 2, 2), 2)
        eight = self.block("block4", self.convolved(4, four, 3, 2), 3)
        four = torch.cat((self.raised(4, eight, 2), four), dim=1)
        two = torch.cat((self.raised(3, four, 1), two), dim=1)
        one = torch.cat((self.raised(2, two, 0), one), dim=1)
        rows = self.grid.read(one, self.levels[0], 1)
        rows = (rows @ self.tensors["conv1_tr.kernel"]).relu()
        rows = rows @ self.tensors["final.kernel"] + self.tensors["final.bias"]
        return rows / rows.norm(dim=1, keepdim=True)


@pytest.mark.parametrize(("width", "first_size"), [(32, 7), (16, 5), (16, 3)])
def test_it_is_the_network_on_a_dense_grid(width, first_size):
    network = random_network(width, first_size)
    coordinates = room_voxels(0.4)
    found = described(network, coordinates)
    reference = DenseReference(network.state_dict(), DenseGrid(-8, 16), coordinates)
    assert torch.allclose(found, reference.descriptors(), atol=1e-9)
    assert found.shape == (len(coordinates), width)
    assert found.std(dim=0).min() > 1e-3


def test_descriptors_do_not_depend_on_the_order_of_voxels():
    network, coordinates = random_network(), room_voxels()
    order = torch.randperm(len(coordinates), generator=torch.Generator().manual_seed(0))
    found = described(network, coordinates)
    assert torch.allclose(described(network, coordinates[order]), found[order], atol=1e-12)


def test_descriptors_move_with_the_coarsest_voxels():
    network, coordinates = random_network(), room_voxels()
    found = described(network, coordinates)
    shift = LARGEST_STRIDE * torch.tensor([3, -5, 1])
    assert torch.allclose(described(network, coordinates + shift), found, atol=1e-12)
    assert not torch.allclose(described(network, coordinates + 1), found, atol=1e-3)


def test_far_parts_do_not_see_each_other():
    network, coordinates = random_network(), room_voxels()
    together = torch.cat((coordinates, coordinates + 64 * LARGEST_STRIDE))
    found = described(network, coordinates)
    assert torch.allclose(described(network, together), torch.cat((found, found)), atol=1e-12)


@pytest.mark.parametrize("count", [0, 1])
def test_few_voxels(count):
    found = described(random_network(), torch.full((count, 3), -1))
    assert found.shape == (count, 16)
    assert torch.allclose(found.norm(dim=1), torch.ones(count, dtype=torch.float64))


@pytest.mark.parametrize("expected", [(32, 7), (16, 5), (16, 3)])
def test_sizes_are_read_off_the_tensors(expected):
    assert sizes(ResUNet(*expected).state_dict()) == expected


def test_it_can_be_trained():
    network = random_network().train()
    voxels = Voxels(room_voxels(0.4))
    occupied = torch.ones(len(voxels), 1, dtype=torch.float64)
    network(occupied, Pyramid.of(voxels, 5))[:, 0].sum().backward()
    assert all(each.grad.abs().max() > 0 for each in network.parameters())
