"""Weights of D3Feat and Predator that any machine can draw again, and a small room to see."""

import hashlib

import numpy as np
import torch
from furnished_room import room

from nss_ros.registration.learned.kernel_point_network import LIMITS, RADIUS
from nss_ros.registration.learned.kernel_points import KernelPointConvolution
from nss_ros.registration.learned.pyramid import grid_subsampled, pyramid

#: A power of two, so that clouds can be moved by whole voxels without rounding.
VOXEL_SIZE = 0.125


def weighted(network):
    """The network with weights and kernel points that depend on nothing; returns it."""
    random = np.random.default_rng(0)
    with torch.no_grad():
        for name, tensor in sorted(network.named_parameters()):
            inside = tensor.shape[-2] if tensor.ndim == 3 and "KPConv" in name else None
            inside = inside or (tensor.shape[1] if tensor.ndim > 1 else 100)
            drawn = random.normal(0, 2 / np.sqrt(inside), tensor.shape)
            tensor.copy_(torch.from_numpy(np.asarray(drawn)))
        for module in network.modules():
            if isinstance(module, KernelPointConvolution):
                drawn = random.normal(0, 0.5 * module.extent, module.kernel_points.shape)
                module.kernel_points.copy_(torch.from_numpy(drawn))
    return network.eval().requires_grad_(False)


def saved(network, path):
    """A checkpoint (path) as the authors' trainers save it."""
    content = {
        "epoch": 39,
        "state_dict": network.state_dict(),
        "optimizer": {"state": {}, "param_groups": [{"lr": 0.005}]},
        "scheduler": {"last_epoch": 39},
        "best_loss": 0.5,
    }
    torch.save(content, path)
    return path


def layout(network):
    """Number of tensors of a network, and a digest of all names and shapes."""
    lines = sorted(f"{name} {tuple(each.shape)}" for name, each in network.state_dict().items())
    return len(lines), hashlib.sha256("\n".join(lines).encode()).hexdigest()


def cloud(seed):
    """A room as the network sees it, (n, 3) float32."""
    return grid_subsampled(room(seed, 0.15), VOXEL_SIZE)


def levels_of(clouds, depth):
    """A pyramid of clouds."""
    cpu = torch.device("cpu")
    return pyramid(clouds, VOXEL_SIZE, RADIUS * VOXEL_SIZE, LIMITS[:depth], cpu)
