"""Weights of GeoTransformer that any machine can draw again."""

import numpy as np
import torch

from nss_ros.registration.learned.kernel_points import KernelPointConvolution


def scale(name):
    """Of weights: superpoints remain different, and attend to few others."""
    if ".linear." in name or ".squeeze." in name:
        return 0.3
    return 3.0 if name.endswith(("proj_q.weight", "proj_k.weight", "proj_p.weight")) else 1.0


def weighted(network):
    """The network with weights that any machine can draw again; returns it."""
    random = np.random.default_rng(7)
    for name, tensor in sorted(network.state_dict().items()):
        if "div_term" not in name and "kernel_points" not in name:
            spread = (
                1 / np.sqrt(tensor.shape[-2 if tensor.dim() == 3 else -1])
                if tensor.dim() > 1
                else 0.2
            )
            drawn = scale(name) * random.normal(0, spread, tensor.shape) + name.endswith(
                "norm.weight"
            )
            tensor.copy_(torch.from_numpy(np.asarray(drawn)))
    for module in network.modules():
        if isinstance(module, KernelPointConvolution):
            drawn = random.normal(0, 0.5 * module.extent, module.kernel_points.shape)
            module.kernel_points.copy_(torch.from_numpy(drawn))
    return network.eval().requires_grad_(False)
