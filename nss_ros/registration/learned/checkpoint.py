"""Trained weights of a learned baseline, from the file that its authors publish."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import ZipFile, is_zipfile

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import Module

from nss_ros.errors import MethodError
from nss_ros.registration.learned.training_record import RECORD_KEY, TrainingRecord

# What a pickled checkpoint may call. Everything else in it becomes a `_Placeholder`: the official
# files hold settings and optimiser states of classes that a reader of weights does not need, and a
# pickle that may call anything is a program.
_SAFE = {
    ("collections", "OrderedDict"),
    ("torch._utils", "_rebuild_tensor"),
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
    ("torch", "Size"),
    ("torch", "device"),
    ("torch", "FloatStorage"),
    ("torch", "DoubleStorage"),
    ("torch", "HalfStorage"),
    ("torch", "LongStorage"),
    ("torch", "IntStorage"),
    ("torch", "ByteStorage"),
    ("torch", "BoolStorage"),
    ("torch.storage", "UntypedStorage"),
}
_HOLDERS = ("state_dict", "model", "model_state_dict")
_SHOWN = 3


def load_weights(
    network: Module, path: str, method: str, published: str, optional: str = ""
) -> None:
    """Fill a network from a checkpoint and make it ready for use (`eval`).

    Args:
        network: whose parameters and buffers are named as those of the official one.
        path: file of the checkpoint (`.pth`, `.pth.tar`, `.tar` or `.safetensors`).
        method: registered name, under which the file is configured.
        published: where the authors publish their checkpoints.
        optional: how the names of tensors end that some checkpoints have none of; the network
            then keeps its own.

    Raises:
        MethodError: no file is given, it cannot be read, or it is of another network.
    """
    tensors = read_weights(path, method, published)
    fill(network, tensors, path, weights_setting(method), optional)


def read_weights(path: str, method: str, published: str) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name, for a network that is made by their shapes.

    Args:
        path: file of the checkpoint (`.pth`, `.pth.tar`, `.tar` or `.safetensors`).
        method: registered name, under which the file is configured.
        published: where the authors publish their checkpoints.

    Raises:
        MethodError: no file is given, or it cannot be read.
    """
    setting = weights_setting(method)
    if not path:
        raise MethodError(
            f"Method '{method}' needs trained weights: set {setting} to a checkpoint of its "
            f"authors' ({published}), or to one that 'nss train' made."
        )
    return read_tensors(Path(path), setting)


def fill(
    network: Module, tensors: Mapping[str, Tensor], path: str, setting: str, optional: str = ""
) -> None:
    """Fill a network with tensors of a checkpoint and make it ready for use (`eval`).

    Args:
        network: as of `load_weights`.
        tensors: by name.
        path: file that they are of.
        setting: under which the file is configured.
        optional: as of `load_weights`.

    Raises:
        MethodError: they are of another network, or not finite.
    """
    expected = network.state_dict()
    if optional and not any(name.endswith(optional) for name in tensors):
        kept = {name: each for name, each in expected.items() if name.endswith(optional)}
        tensors = {**tensors, **kept}
    _check(expected, tensors, path, setting)
    network.load_state_dict({name: tensors[name] for name in expected})
    network.eval()
    network.requires_grad_(False)


def weights_setting(method: str) -> str:
    """The setting that names the checkpoint of a registration method."""
    return f"registration.{method}.weights"


def _check(
    expected: Mapping[str, Tensor], tensors: Mapping[str, Tensor], path: str, setting: str
) -> None:
    """That a file has exactly the tensors of a network, of finite numbers."""
    wrong = [
        *(f"'{name}' is missing" for name in expected if name not in tensors),
        *(f"'{name}' is not of this network" for name in tensors if name not in expected),
        *(
            f"'{name}' is {tuple(tensors[name].shape)} instead of {tuple(tensor.shape)}"
            for name, tensor in expected.items()
            if name in tensors and tensors[name].shape != tensor.shape
        ),
    ]
    if wrong:
        shown = ", ".join(wrong[:_SHOWN]) + (
            f" and {len(wrong) - _SHOWN} more" if len(wrong) > _SHOWN else ""
        )
        raise MethodError(
            f"{path} holds weights of another network ({shown}): set {setting} to another file."
        )
    broken = next((name for name in expected if not tensors[name].isfinite().all()), None)
    if broken is not None:
        raise MethodError(
            f"{path} holds numbers that are not finite ('{broken}'): set {setting} to another file."
        )


def read_tensors(path: Path, setting: str) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name.

    Args:
        path: its file.
        setting: under which the file is configured.

    Raises:
        MethodError: there is no such file, or it is not a checkpoint.
    """
    try:
        content = load_file(path) if path.suffix == ".safetensors" else _unpickled(path)
    except FileNotFoundError as error:
        raise MethodError(f"There is no file {path}: set {setting} to a checkpoint.") from error
    except Exception as error:
        raise MethodError(
            f"{path} is not a checkpoint of PyTorch ({error}): set {setting} to one."
        ) from error
    return _state(content, path, setting)


def read_record(path: Path) -> TrainingRecord | None:
    """What a checkpoint of `nss train` tells of itself; None of any other file."""
    try:
        content = None if path.suffix == ".safetensors" else _unpickled(path)
    except Exception:  # whoever reads the weights tells what is wrong
        return None
    return TrainingRecord.from_json(content.get(RECORD_KEY)) if isinstance(content, dict) else None


def _unpickled(path: Path) -> Any:
    """What a file of `torch.save` holds, of which nothing but tensors and containers is made."""
    if is_zipfile(path):
        with ZipFile(path) as archive:
            # `torch.load` would hand a program to TorchScript, which runs parts of it.
            if any(PurePosixPath(name).name == "constants.pkl" for name in archive.namelist()):
                raise ValueError("it is a TorchScript program")
    return torch.load(path, map_location="cpu", weights_only=False, pickle_module=_TensorsOnly)


def _state(content: Any, path: Path, setting: str) -> dict[str, Tensor]:
    """The tensors of a network, which checkpoints keep beside other things."""
    for holder in _HOLDERS:
        if isinstance(content, Mapping) and isinstance(content.get(holder), Mapping):
            content = content[holder]
    tensors = (
        {str(name): each for name, each in content.items() if isinstance(each, Tensor)}
        if isinstance(content, Mapping)
        else {}
    )
    if not tensors:
        raise MethodError(f"{path} holds no weights: set {setting} to a checkpoint.")
    if all(name.startswith("module.") for name in tensors):  # saved from several GPUs
        tensors = {name.removeprefix("module."): each for name, each in tensors.items()}
    return tensors


class _Placeholder:
    """In the place of what is not loaded; takes whatever a pickle does to it."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> _Placeholder:
        return self

    def __setstate__(self, _: Any) -> None:
        pass

    def __setitem__(self, *_: Any) -> None:
        pass

    def append(self, _: Any) -> None:
        """An item of a list of an unknown class."""

    def extend(self, _: Any) -> None:
        """Items of a list of an unknown class."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _SAFE:
            return super().find_class(module, name)
        return _Placeholder


class _TensorsOnly:
    """Stands in for the module `pickle` in `torch.load`."""

    Unpickler = _Unpickler

    @staticmethod
    def load(file: Any, **options: Any) -> Any:
        """As `pickle.load`."""
        return _Unpickler(file, **options).load()


def chosen_device(name: str) -> torch.device:
    """The device of a setting: `auto` is a GPU where there is one.

    Raises:
        MethodError: a GPU is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise MethodError("This machine has no CUDA device: set the method's device to 'cpu'.")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)
