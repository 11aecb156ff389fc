"""The network: one step of an optimiser that is learned, made again and again.

Every node of a graph has a pose and a feature vector. In a step each edge tells both of its nodes
by how much its relative transform misses their poses; each node weighs what its edges tell, sums
it up, and moves. All of this is in the node's own frame, so a change of the map frame changes
nothing. Parameters are named as those of the authors, so that their checkpoints fit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nss_ros.multiway.posegraphnet.rigid import Rigid, exponential

NODE_FEATURES = 16
GRAPH_FEATURES = 4
#: Width of the hidden layers of the published checkpoints.
PUBLISHED_WIDTH = 256
#: Steps of the published checkpoints.
PUBLISHED_STEPS = 10
_TWIST, _TRANSFORM = 6, 12
_MESSAGE = 2 * NODE_FEATURES + _TRANSFORM
_LEAST_NORM = 1e-4


class GraphTensors(NamedTuple):
    """One or more graphs.

    Attributes:
        source: (e,) node of each edge.
        target: (e,) the other one.
        measured: (e) `T_target_source`.
        graph: (n,) which graph each node is of, from 0, ascending.
    """

    source: Tensor
    target: Tensor
    measured: Rigid
    graph: Tensor


class State(NamedTuple):
    """Where an optimisation stands.

    Attributes:
        poses: (n) `T_fragment_map`.
        nodes: (n, NODE_FEATURES).
        graphs: (g, GRAPH_FEATURES).
        logits: (2 e,) how right each edge is, as its target sees it and then as its source does.
    """

    poses: Rigid
    nodes: Tensor
    graphs: Tensor
    logits: Tensor


class SynchronizationNetwork(nn.Module):
    """The network of Yew and Lee with weighted sums as aggregation.

    Args:
        width: of the hidden layers.
    """

    def __init__(self, width: int = PUBLISHED_WIDTH) -> None:
        super().__init__()
        self.meta_op = _Step(width)

    def forward(self, graphs: GraphTensors, start: Rigid, steps: int) -> list[State]:
        """The states after each of some steps.

        Args:
            graphs: of which all nodes move.
            start: (n) `T_fragment_map` at first.
            steps: how many.
        """
        routes = _Routes.of(graphs, len(start.translation))
        blank = start.translation.new_zeros
        state = State(
            start,
            blank(len(start.translation), NODE_FEATURES),
            blank(len(routes.sizes), GRAPH_FEATURES),
            blank(len(routes.receiver)),
        )
        states = []
        for _ in range(steps):
            state = self.meta_op(routes, state)
            states.append(state)
        return states


class _Routes(NamedTuple):
    """Messages of a graph, two for each edge: to its target, and to its source.

    Attributes:
        sender: (2 e,) node.
        receiver: (2 e,) node.
        measured: (2 e) `T_receiver_sender`.
        graph: (n,) graph of each node.
        sizes: (g, 1) nodes of each graph.
        order: (2 e,) messages sorted by receiver.
        counts: (n,) messages to each node.
    """

    sender: Tensor
    receiver: Tensor
    measured: Rigid
    graph: Tensor
    sizes: Tensor
    order: Tensor
    counts: Tensor

    @classmethod
    def of(cls, graphs: GraphTensors, count: int) -> _Routes:
        receiver = torch.cat((graphs.target, graphs.source))
        back = graphs.measured.inverse()
        measured = Rigid(
            torch.cat((graphs.measured.rotation, back.rotation)),
            torch.cat((graphs.measured.translation, back.translation)),
        )
        return cls(
            torch.cat((graphs.source, graphs.target)),
            receiver,
            measured,
            graphs.graph,
            torch.bincount(graphs.graph).to(measured.translation)[:, None],
            torch.argsort(receiver, stable=True),
            torch.bincount(receiver, minlength=count),
        )

    def largest(self, messages: Tensor) -> Tensor:
        """Largest of the messages (2 e, k), none negative, to each node, (n, k); 0 without any."""
        ordered = messages.index_select(0, self.order)
        return torch.segment_reduce(ordered, "max", lengths=self.counts, axis=0, initial=0.0)

    def sums(self, messages: Tensor) -> Tensor:
        """Sum of the messages (2 e, k) to each node, (n, k)."""
        zero = messages.new_zeros(len(self.graph), messages.shape[1])
        return zero.index_add(0, self.receiver, messages)


class _Step(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.node_model = _NodeModel(width)
        self.global_model = _GlobalModel(width)

    def forward(self, routes: _Routes, state: State) -> State:
        graphs: Tensor = self.global_model(routes, state)
        moved: State = self.node_model(routes, state._replace(graphs=graphs))
        return moved


class _GlobalModel(nn.Module):
    """What all nodes of a graph share."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.global_mlp = nn.Sequential(
            nn.Linear(GRAPH_FEATURES + NODE_FEATURES, width),
            nn.ReLU(),
            nn.Linear(width, GRAPH_FEATURES),
        )

    def forward(self, routes: _Routes, state: State) -> Tensor:
        zero = state.nodes.new_zeros(len(routes.sizes), NODE_FEATURES)
        mean = zero.index_add(0, routes.graph, state.nodes) / routes.sizes
        graphs: Tensor = self.global_mlp(torch.cat((state.graphs, mean), dim=1))
        return graphs


class _NodeModel(nn.Module):
    """What edges tell nodes, how it is weighed, and what nodes make of it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.node_mlp_1 = nn.Sequential(
            nn.Linear(_MESSAGE, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.node_mlp_2 = nn.Sequential(
            nn.Linear(width + GRAPH_FEATURES + NODE_FEATURES, width),
            nn.ReLU(),
            nn.Linear(width, NODE_FEATURES + _TWIST),
        )
        self.weights_mlp_1 = nn.Sequential(
            nn.Linear(_MESSAGE, width), nn.ReLU(), nn.Linear(width, width // 2), nn.ReLU()
        )
        self.weights_mlp_2 = nn.Sequential(
            nn.Linear(width // 2 * 2, width), nn.ReLU(), nn.Linear(width, 1)
        )

    def forward(self, routes: _Routes, state: State) -> State:
        messages = _messages(routes, state)
        logits = self._logits(routes, messages)
        told = self.node_mlp_1(messages) * torch.sigmoid(logits)[:, None]
        summed = routes.sums(told)
        # Only the direction of the sum counts, so nodes with many edges are as those with few.
        summed = summed / (summed.norm(dim=1, keepdim=True) + _LEAST_NORM)
        shared = state.graphs.index_select(0, routes.graph)
        change = self.node_mlp_2(torch.cat((summed, state.nodes, shared), dim=1))
        features, twists = change[:, :NODE_FEATURES], change[:, NODE_FEATURES:]
        poses = exponential(_squashed(twists)) @ state.poses
        return State(poses, state.nodes + features, state.graphs, logits)

    def _logits(self, routes: _Routes, messages: Tensor) -> Tensor:
        """How right each message is, beside the others that its receiver gets, (2 e,)."""
        own = self.weights_mlp_1(messages)
        others = routes.largest(own).index_select(0, routes.receiver)
        logits: Tensor = self.weights_mlp_2(torch.cat((own, others), dim=1)).squeeze(1)
        return logits


def _messages(routes: _Routes, state: State) -> Tensor:
    """Features of sender and receiver, and by how much the receiver's pose misses, (2 e, 44)."""
    receivers = state.poses.take(routes.receiver)
    expected = routes.measured @ state.poses.take(routes.sender)
    missed = receivers @ expected.inverse()
    nodes = state.nodes
    return torch.cat(
        (
            nodes.index_select(0, routes.sender),
            nodes.index_select(0, routes.receiver),
            missed.vectors(),
        ),
        dim=1,
    )


def _squashed(twists: Tensor) -> Tensor:
    """Twists (n, 6) that turn by less than half a turn."""
    shift, turn = twists[:, :3], twists[:, 3:]
    # The root has no gradient at zero.
    square = (turn * turn).sum(dim=1, keepdim=True)
    length = square.clamp_min(1e-18).sqrt()
    return torch.cat((shift, math.pi * turn * length / (1 + square)), dim=1)
