"""The trained networks with a part taken away, to tell what the part is worth.

Nothing is trained anew, so a part that others lean on is worth less than its absence costs here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy

import torch
from torch import nn

from nss_ros.registration.gravity.network import Head
from nss_ros.registration.gravity.refinement import SIGNS
from nss_ros.registration.gravity.verifier import Verifier
from nss_ros.registration.gravity.weights import Networks

# A verifier that only ranks by a sign: in which range of it, and how much its probabilities differ.
# So little that no hypothesis is left out for being improbable.
_RANGE, _SLOPE = 20.0, 0.1


def without_learning(networks: Networks) -> Networks:
    """Weights set by hand: normals that agree, and surfaces in free space, slice by slice."""
    networks = deepcopy(networks)
    for head in _heads(networks):
        by_hand = Head(head.outputs.in_channels)
        nn.init.zeros_(by_hand.outputs.weight)
        head.load_state_dict(by_hand.state_dict())
    return networks


def without_free_space(networks: Networks) -> Networks:
    """What lies where the other scanner saw that nothing is counts nothing in the search."""
    networks = deepcopy(networks)
    for head in _heads(networks):
        nn.init.zeros_(head.surface)
        nn.init.zeros_(head.empty)
    return networks


def without_second_look(networks: Networks) -> Networks:
    """All aligned hypotheses look the same to the second look, as they do on average."""
    networks = deepcopy(networks)
    last = networks.comparison.leave[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    nn.init.constant_(last.bias, float(networks.verifier.mean[SIGNS.index("comparison")]))
    return networks


def without_verifier(networks: Networks) -> Networks:
    """Hypotheses are ranked by their scores on the maps, aligned; probabilities mean nothing."""
    verifier = Verifier()
    for parameter in verifier.parameters():
        nn.init.zeros_(parameter)
    sign = SIGNS.index("margin_aligned")
    with torch.no_grad():
        verifier.deviation[sign] = _RANGE
        hidden, out = verifier.score[0], verifier.score[2]
        hidden.weight[0, sign] = _SLOPE  # type: ignore[operator]
        out.weight[0, 0] = 1.0  # type: ignore[operator]
    return networks._replace(verifier=verifier)


#: What is taken away, by what it is called in tables.
ABLATIONS: Mapping[str, Callable[[Networks], Networks]] = {
    "without second look": without_second_look,
    "without verifier": without_verifier,
    "without verifier, free space": lambda n: without_verifier(without_free_space(n)),
    "without verifier, learned weights": lambda n: without_verifier(without_learning(n)),
}


def _heads(networks: Networks) -> list[Head]:
    return [head for head in networks.network.heads if isinstance(head, Head)]
