"""The trained weights that come with the package."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import NamedTuple

from safetensors.torch import load, save
from torch import Tensor
from torch.nn import Module

from nss_ros.errors import MethodError
from nss_ros.files import write_file
from nss_ros.registration.gravity.comparison import Comparison
from nss_ros.registration.gravity.network import GravityNetwork
from nss_ros.registration.gravity.verifier import Verifier

_FILE = "gravity.safetensors"
_NETWORK = "network."


class Networks(NamedTuple):
    """What is trained.

    Attributes:
        network: the features by which all poses are scored.
        comparison: the second look at those that are aligned.
        verifier: their probabilities.
    """

    network: GravityNetwork
    comparison: Comparison
    verifier: Verifier

    @classmethod
    def untrained(cls) -> Networks:
        """Networks with weights at random."""
        return cls(GravityNetwork(), Comparison(), Verifier())

    def parts(self) -> dict[str, Module]:
        """The networks by the beginning of the names of their tensors in a file."""
        return {_NETWORK: self.network, "comparison.": self.comparison, "verifier.": self.verifier}


@cache
def load_weights(path: str = "") -> Networks:
    """The trained networks, from a file or, without one, as they come with the package.

    Raises:
        MethodError: there is no such file, or it is not of this method.
    """
    source = Path(path) if path else files("nss_ros.registration.gravity") / _FILE
    networks = Networks.untrained()
    _load(source, networks.parts())
    for each in networks:
        each.eval()
    return networks


def load_network(path: Path) -> GravityNetwork:
    """The network of a file of weights, to be trained further.

    Raises:
        MethodError: there is no such file, or it is not of this method.
    """
    network = GravityNetwork()
    _load(path, {_NETWORK: network})
    return network


def _load(source: Traversable, modules: Mapping[str, Module]) -> None:
    try:
        tensors = load(source.read_bytes())
        for prefix, module in modules.items():
            module.load_state_dict(_part(tensors, prefix))
    except Exception as error:
        raise MethodError(
            f"{source} does not hold weights of the method gravity: {error}"
        ) from error


def save_weights(path: Path, networks: Networks) -> None:
    """Writes the networks to a file."""
    tensors = {
        prefix + name: value.contiguous()
        for prefix, module in networks.parts().items()
        for name, value in module.state_dict().items()
    }
    write_file(path, save(tensors))


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }
