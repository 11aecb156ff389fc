"""Checkpoints as the authors of learned methods write them, with weights at random."""

import sys
from types import ModuleType

import numpy as np
import torch


def random_tensors(network, seed=0):
    """Tensors of a network, also the statistics of its normalisations, at random."""
    random = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, tensor in network.state_dict().items():
        if name.endswith("running_var"):
            tensors[name] = torch.rand(tensor.shape, generator=random) + 0.5
        elif tensor.is_floating_point() and tensor.dim() == 1:
            tensors[name] = tensor + 0.2 * torch.randn(tensor.shape, generator=random)
        else:
            tensors[name] = tensor.clone()
    return tensors


def write_checkpoint(path, tensors, zipped=True, **others):
    """Write tensors under 'state_dict', beside settings of a class that no reader has."""
    content = {
        "arch": "ResUNet",
        "epoch": 3,
        "state_dict": tensors,
        "best_val": np.float64(0.5),
        "optimizer": {"state": {0: {"momentum_buffer": torch.ones(2)}}, "param_groups": [{}]},
        **others,
    }
    module = ModuleType("settings_of_the_authors")

    class Settings(dict):
        pass

    Settings.__module__, Settings.__qualname__ = module.__name__, "Settings"
    module.Settings = Settings
    content["config"] = Settings(model_n_out=32, voxel_size=0.05, nested=Settings(more=[1]))
    content["config"].normalize_feature = True
    sys.modules[module.__name__] = module
    try:
        torch.save(content, path, _use_new_zipfile_serialization=zipped)
    finally:
        del sys.modules[module.__name__]
    return str(path)
