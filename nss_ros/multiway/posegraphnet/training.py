"""Trains the network on simulated graphs.

The loss is that of the paper: after a step, the distance of the relative transforms of pairs of
fragments from the true ones, summed over the entries of their matrices, and the cross-entropy of
which edges are right; later steps count more, the first ones of many not at all. Neither depends
on the map frame. Only fragments that right edges link are compared, since nothing says where the
others are.

Unlike in the paper, far distances count by their logarithm: in graphs of buildings parts are
displaced by a bay or more, often with nothing to tell it by, and such errors would drown those of
decimetres. The network starts from a spanning tree or from where it came itself, and it begins to
learn with steps that hardly move anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from nss_ros.multiway.posegraphnet.network import (
    NODE_FEATURES,
    GraphTensors,
    State,
    SynchronizationNetwork,
)
from nss_ros.multiway.posegraphnet.rigid import Rigid
from nss_ros.multiway.posegraphnet.simulated_graph import SimulatedGraph
from nss_ros.multiway.posegraphnet.start import graph_tensors, pose_tensors, tree_poses
from nss_ros.multiway.spanning_tree import Closeness, components

# Of the cross-entropy beside the distances (the authors' code: 5), and of a step beside the next
# one (0.5 there, too).
_EDGE_WEIGHT, _STEP_WEIGHT = 1.0, 0.5
# Steps before the last ones weigh next to nothing.
_JUDGED_STEPS = 4
# Distance up to which errors count in full, sum of metres and entries of rotations.
_NEAR = 1.0
# Compared pairs of fragments of each graph.
_MOST_PAIRS = 200
# Of the weights that move nodes, at first.
_CALM = 0.1
_GRADIENT_LIMIT = 1.0
_WARM_UP = 0.05


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """How the network is trained.

    Attributes:
        steps: of the optimiser.
        batch: graphs in each.
        network_steps: steps of the network that gradients flow through.
        rounds: the network starts from where up to so many rounds less one of it have led.
        learning_rate: the largest one.
        seed: of everything that is drawn.
    """

    steps: int = 4000
    batch: int = 8
    network_steps: int = 6
    rounds: int = 3
    learning_rate: float = 1e-3
    seed: int = 0


class Lesson(NamedTuple):
    """A graph to learn from.

    Attributes:
        graph: its tensors, float32.
        start: (n) `T_fragment_map` of a spanning tree.
        truth: (n) `T_fragment_map`.
        right: (e,) 1 for right edges, 0 for others.
        part: (n,) which nodes right edges link.
    """

    graph: GraphTensors
    start: Rigid
    truth: Rigid
    right: Tensor
    part: Tensor


def calm(network: SynchronizationNetwork) -> None:
    """Let an untrained network hardly move anything."""
    last = network.meta_op.node_model.node_mlp_2[-1]
    with torch.no_grad():
        for parameter in last.parameters():
            parameter[NODE_FEATURES:] *= _CALM


def lesson(graph: SimulatedGraph, close: Closeness) -> Lesson:
    """What is learned from a simulated graph."""
    ids = graph.fragments
    tensors = graph_tensors(ids, graph.measurements)
    right = [m for m, is_right in zip(graph.measurements, graph.right, strict=True) if is_right]
    part = {id_: n for n, members in enumerate(components(ids, right)) for id_ in members}
    return Lesson(
        tensors._replace(measured=_single(tensors.measured)),
        _single(pose_tensors(tree_poses(ids, graph.measurements, close), ids)),
        _single(pose_tensors(graph.poses, ids)),
        torch.from_numpy(graph.right.astype(np.float32)),
        torch.tensor([part[id_] for id_ in ids]),
    )


def train(
    network: SynchronizationNetwork, lessons: Sequence[Lesson], config: TrainingConfig
) -> Iterator[float]:
    """Train in place; the loss of each step of the optimiser."""
    rng = np.random.default_rng(config.seed)
    optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: _rate(step / max(config.steps, 1))
    )
    network.train()
    for _ in range(config.steps):
        chosen = rng.choice(len(lessons), min(config.batch, len(lessons)), replace=False)
        batch = joined([varied(lessons[i], rng) for i in chosen])
        start = batch.start
        with torch.no_grad():
            for _ in range(int(rng.integers(config.rounds))):
                start = network(batch.graph, start, config.network_steps)[-1].poses
        states = network(batch.graph, start, config.network_steps)
        loss = sequence_loss(states, batch, compared_pairs(batch, rng))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), _GRADIENT_LIMIT)
        optimizer.step()
        schedule.step()
        yield float(loss.detach())
    network.eval()


def varied(one: Lesson, rng: np.random.Generator) -> Lesson:
    """The same graph with every fragment turned about its vertical, half of them mirrored."""
    angles = torch.from_numpy(rng.uniform(-math.pi, math.pi, len(one.part)).astype(np.float32))
    turns = _turns(angles)
    measured, start, truth = one.graph.measured, one.start, one.truth
    if rng.random() < 0.5:
        measured, start, truth = (_mirrored(each) for each in (measured, start, truth))
    back = turns.inverse()
    measured = turns.take(one.graph.target) @ measured @ back.take(one.graph.source)
    return one._replace(
        graph=one.graph._replace(measured=measured), start=turns @ start, truth=turns @ truth
    )


def joined(lessons: Sequence[Lesson]) -> Lesson:
    """Several graphs as one of several components."""
    counts = torch.tensor([len(each.part) for each in lessons])
    shifts = torch.cumsum(counts, 0) - counts
    graph = GraphTensors(
        torch.cat([each.graph.source + s for each, s in zip(lessons, shifts, strict=True)]),
        torch.cat([each.graph.target + s for each, s in zip(lessons, shifts, strict=True)]),
        _stacked([each.graph.measured for each in lessons]),
        torch.repeat_interleave(counts),
    )
    return Lesson(
        graph,
        _stacked([each.start for each in lessons]),
        _stacked([each.truth for each in lessons]),
        torch.cat([each.right for each in lessons]),
        # Parts of different graphs must differ.
        torch.cat([each.part + s for each, s in zip(lessons, shifts, strict=True)]),
    )


def compared_pairs(batch: Lesson, rng: np.random.Generator) -> Tensor:
    """Nodes (2, k) of pairs that right edges link, at most some hundred of each graph."""
    pairs = []
    for number in range(int(batch.graph.graph[-1]) + 1):
        nodes = torch.nonzero(batch.graph.graph == number).squeeze(1)
        first, second = torch.combinations(nodes).unbind(dim=1)
        linked = torch.nonzero(batch.part[first] == batch.part[second]).squeeze(1)
        drawn = linked[torch.from_numpy(rng.permutation(len(linked))[:_MOST_PAIRS])]
        pairs.append(torch.stack((first[drawn], second[drawn])))
    return torch.cat(pairs, dim=1)


def sequence_loss(states: Sequence[State], batch: Lesson, pairs: Tensor) -> Tensor:
    """The loss of the last steps of the network."""
    first, second = pairs
    truth = _between(batch.truth, first, second)
    right = torch.cat((batch.right, batch.right))
    total = torch.zeros(())
    for state in states[-_JUDGED_STEPS:]:
        total = total * _STEP_WEIGHT
        if pairs.shape[1]:
            missed = _between(state.poses, first, second).vectors() - truth.vectors()
            distances = missed.abs().sum(dim=1)
            total = total + (_NEAR * torch.log1p(distances / _NEAR)).mean()
        total = total + _EDGE_WEIGHT * binary_cross_entropy_with_logits(state.logits, right)
    return total


def _between(poses: Rigid, first: Tensor, second: Tensor) -> Rigid:
    return poses.take(second) @ poses.take(first).inverse()


def _rate(progress: float) -> float:
    """Share of the largest learning rate: up at first, then down along a cosine."""
    if progress < _WARM_UP:
        return (progress + 0.01) / (_WARM_UP + 0.01)
    return 0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * (progress - _WARM_UP) / (1 - _WARM_UP)))


def _single(transforms: Rigid) -> Rigid:
    return Rigid(*(each.to(torch.float32) for each in transforms))


def _stacked(transforms: Sequence[Rigid]) -> Rigid:
    return Rigid(
        torch.cat([each.rotation for each in transforms]),
        torch.cat([each.translation for each in transforms]),
    )


def _turns(angles: Tensor) -> Rigid:
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    sine, cosine = angles.sin(), angles.cos()
    rows = (cosine, -sine, zero, sine, cosine, zero, zero, zero, one)
    return Rigid(torch.stack(rows, dim=1).reshape(-1, 3, 3), angles.new_zeros(len(angles), 3))


def _mirrored(transforms: Rigid) -> Rigid:
    """Transforms as seen in a mirror on the x-z plane."""
    flip = torch.tensor([1.0, -1.0, 1.0])
    return Rigid(transforms.rotation * torch.outer(flip, flip), transforms.translation * flip)
