"""Trains the weights of the synchronizer `posegraphnet` on simulated graphs.

    ./nss python -m nss_ros.multiway.posegraphnet.train -o FILE

All graphs are drawn at random; no recorded site and no published weights are used.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import torch

from nss_ros.cli.progress import progress_bar
from nss_ros.config import MultiwayConfig
from nss_ros.errors import NssError
from nss_ros.multiway.posegraphnet.network import SynchronizationNetwork
from nss_ros.multiway.posegraphnet.simulated_graph import GraphSettings, simulated_graph
from nss_ros.multiway.posegraphnet.training import Lesson, TrainingConfig, calm, lesson, train
from nss_ros.multiway.posegraphnet.weights import Usage, save_weights
from nss_ros.multiway.spanning_tree import Closeness

# Keeps the seeds of training graphs apart from those of held-out ones.
_LEARNED = 0
_REPORTED = 100


def main() -> None:
    """Train and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--graphs", type=int, default=2400, help="that are drawn")
    parser.add_argument("--steps", type=int, default=8000, help="of the optimiser")
    parser.add_argument("--batch", type=int, default=8, help="graphs in a step")
    parser.add_argument("--width", type=int, default=64, help="of the hidden layers")
    parser.add_argument("--learning-rate", type=float, default=1.5e-3, help="the largest one")
    parser.add_argument(
        "--network-steps", type=int, default=6, help="from blank features on, in a round"
    )
    parser.add_argument("--rounds", type=int, default=5, help="of the network in use")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    try:
        fit(arguments)
    except NssError as error:
        sys.exit(f"error: {error}")


def fit(arguments: argparse.Namespace) -> None:
    """Train as asked for."""
    # The sums of one thread are always the same.
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    network = SynchronizationNetwork(arguments.width)
    calm(network)
    settings = TrainingConfig(
        steps=arguments.steps,
        batch=arguments.batch,
        network_steps=arguments.network_steps,
        learning_rate=arguments.learning_rate,
        seed=arguments.seed,
    )
    usage = Usage("tree", arguments.network_steps, arguments.rounds)
    with progress_bar() as bar:
        numbers = bar.track(range(arguments.graphs), description="graphs")
        lessons = [drawn_lesson(arguments.seed, number) for number in numbers]
        task = bar.add_task("network", total=settings.steps)
        losses: list[float] = []
        for loss in train(network, lessons, settings):
            losses.append(loss)
            bar.update(task, completed=len(losses))
            if len(losses) % _REPORTED == 0 or len(losses) == settings.steps:
                save_weights(arguments.output, network, usage)
                print(f"step {len(losses)}: loss {np.mean(losses[-_REPORTED:]):.3f}", flush=True)


def drawn_lesson(seed: int, number: int) -> Lesson:
    """A graph of those to learn from, as `posegraphnet` would start on it."""
    config = MultiwayConfig()
    close = Closeness(config.loop_translation, math.radians(config.loop_rotation))
    graph = simulated_graph(np.random.default_rng((_LEARNED, seed, number)), GraphSettings())
    return lesson(graph, close)


if __name__ == "__main__":
    main()
