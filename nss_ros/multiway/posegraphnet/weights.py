"""Trained weights: those that come with the package, others of its training, published ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal, get_args

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from nss_ros.errors import MethodError
from nss_ros.files import write_file
from nss_ros.multiway.posegraphnet.network import PUBLISHED_STEPS, SynchronizationNetwork
from nss_ros.registration.learned.checkpoint import fill, read_tensors

SETTING = "pose_graph.posegraphnet_weights"
_FILE = "posegraphnet.safetensors"
_METADATA = "posegraphnet"
_WIDTH_KEY = "meta_op.node_model.node_mlp_1.0.weight"

Start = Literal["identity", "tree"]


@dataclass(frozen=True, slots=True)
class Usage:
    """How a network is run; as it was trained. The published ones are run as by default.

    Attributes:
        start: poses at first: all the same, or those of a spanning tree.
        steps: of the network, from blank features on.
        rounds: how often, each from the poses of the one before.
    """

    start: Start = "identity"
    steps: int = PUBLISHED_STEPS
    rounds: int = 1


def load_weights(path: str = "") -> tuple[SynchronizationNetwork, Usage]:
    """The trained network, from a file or, without one, as it comes with the package.

    Raises:
        MethodError: there is no such file, or it is not of this network.
    """
    if path:
        return _load(Path(path))
    with as_file(files("nss_ros.multiway.posegraphnet") / _FILE) as shipped:
        return _load(shipped)


def save_weights(path: Path, network: SynchronizationNetwork, usage: Usage) -> None:
    """Write a network to a `.safetensors` file, with how it is run."""
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    write_file(path, save(tensors, {_METADATA: json.dumps(asdict(usage))}))


def _load(path: Path) -> tuple[SynchronizationNetwork, Usage]:
    tensors = read_tensors(path, SETTING)
    network = SynchronizationNetwork(_width(tensors, path))
    fill(network, tensors, str(path), SETTING)
    return network.double(), _usage(path)


def _width(tensors: Mapping[str, Tensor], path: Path) -> int:
    weight = tensors.get(_WIDTH_KEY)
    if weight is None or weight.dim() != 2 or len(weight) < 2:
        raise MethodError(
            f"{path} holds weights of another network ('{_WIDTH_KEY}' is missing): "
            f"set {SETTING} to another file."
        )
    return len(weight)


def _usage(path: Path) -> Usage:
    """How the network of a file is run; as the published ones where the file does not say."""
    if path.suffix != ".safetensors":
        return Usage()
    with safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get(_METADATA)
    if text is None:
        return Usage()
    try:
        usage = Usage(**json.loads(text))
    except (TypeError, ValueError) as error:
        raise MethodError(f"{path} does not say how its network is run: {error}.") from error
    if usage.start not in get_args(Start) or usage.steps < 1 or usage.rounds < 1:
        raise MethodError(f"{path} does not say how its network is run: {usage}.")
    return usage
