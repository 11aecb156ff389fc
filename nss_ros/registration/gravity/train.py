"""Trains the weights of the gravity method from simulated datasets.

    ./nss python -m nss_ros.registration.gravity.train DATASET... --verifier DATASET... -o FILE

With `--start` the network of other weights is trained further, for instance on sites of one's own.
The second look and the verifier learn from pairs of datasets of their own: their hypotheses must be
as good and as bad as those of sites that the network has not seen. For the same reason the verifier
is shown second looks at pairs by a network that did not learn from them: two are trained on one
half of the pairs each, the one that is kept on all of them.
"""

from __future__ import annotations

import argparse
import sys
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import Progress

from nss_ros.cli.progress import progress_bar
from nss_ros.config import RegistrationConfig
from nss_ros.errors import NssError
from nss_ros.registration.gravity.comparison import Comparison
from nss_ros.registration.gravity.comparison_training import train_comparison, with_looks
from nss_ros.registration.gravity.method import Gravity, GravityFeatures
from nss_ros.registration.gravity.training import TrainingConfig, train
from nss_ros.registration.gravity.training_data import (
    ExampleSource,
    Item,
    read_items,
    relative_truth,
)
from nss_ros.registration.gravity.verifier_training import Case, case_of, train_verifier
from nss_ros.registration.gravity.weights import Networks, load_network, save_weights

_APART_SHARE = 0.2
_CACHE = 400


def main() -> None:
    """Train and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("datasets", type=Path, nargs="+", help="that the network learns from")
    parser.add_argument(
        "--verifier",
        type=Path,
        nargs="+",
        required=True,
        help="datasets of other seeds, for the second look and the verifier",
    )
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--start", type=Path, help="weights whose network is trained further")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--learning-rate", type=float, default=2e-3, help="the largest one")
    parser.add_argument("--verifier-pairs", type=int, default=3000)
    parser.add_argument("--comparison-steps", type=int, default=4400, help="of the second look")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0, help="processes that read; 0: all cores")
    parser.add_argument(
        "--threads", type=int, default=1, help="more are faster and give other last digits"
    )
    arguments = parser.parse_args()
    both = {each.resolve() for each in arguments.datasets} & {
        each.resolve() for each in arguments.verifier
    }
    if both:
        parser.error(f"the verifier must not learn from what the network did: {min(both)}")
    try:
        fit(arguments)
    except NssError as error:
        sys.exit(f"error: {error}")


def fit(arguments: argparse.Namespace) -> None:
    """Train as asked for."""
    config = RegistrationConfig(method="gravity", seed=arguments.seed)
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(arguments.seed)
    networks = Networks.untrained()
    if arguments.start:
        networks = networks._replace(network=load_network(arguments.start))
    items = read_items(arguments.datasets, config, arguments.workers)
    with progress_bar() as bar:
        task = bar.add_task("network", total=arguments.steps)
        settings = TrainingConfig(
            steps=arguments.steps, learning_rate=arguments.learning_rate, seed=arguments.seed
        )
        for step, loss, hits in train(networks.network, items, settings):
            bar.update(task, completed=step + 1, description=f"loss {loss:.2f}, hits {hits:.2f}")
        cases = collect(
            Gravity(config, networks),
            read_items(arguments.verifier, config, arguments.workers),
            arguments.verifier_pairs,
            arguments.seed,
            bar,
        )
        cases = looked_at(cases, networks, arguments.comparison_steps, arguments.seed, bar)
    loss = train_verifier(networks.verifier, cases, arguments.seed)
    print(f"verifier: loss {loss:.3f}")
    save_weights(arguments.output, networks)


def looked_at(
    cases: list[Case], networks: Networks, steps: int, seed: int, bar: Progress
) -> list[Case]:
    """Trains the second look; the cases with the signs of others, which did not see them."""
    halves = cases[0::2], cases[1::2]
    looked: list[Case] = []
    trainings = [
        (Comparison(), half, steps // 2, f"second look, half {number}")
        for number, half in enumerate(halves, 1)
    ]
    for comparison, part, count, name in (
        *trainings,
        (networks.comparison, cases, steps, "second look"),
    ):
        task = bar.add_task(name, total=count)
        for step, loss in train_comparison(comparison, part, count, seed):
            bar.update(task, completed=step + 1, description=f"{name}, loss {loss:.2f}")
    for (comparison, *_), half in zip(trainings, reversed(halves), strict=True):
        looked.extend(with_looks(half, comparison))
    return looked


def collect(method: Gravity, items: list[Item], count: int, seed: int, bar: Progress) -> list[Case]:
    """Hypotheses of pairs drawn from prepared fragments, with what is right."""

    @lru_cache(_CACHE)
    def features(number: int) -> GravityFeatures:
        return method.prepare_scan(items[number].scan)

    @cache
    def maps(number: int) -> NDArray[np.float16]:
        found = features(number).maps
        assert found is not None
        return found.astype(np.float16)

    rng = np.random.default_rng(seed)
    examples = ExampleSource(items, seed)
    cases = []
    for _ in bar.track(range(count), description="pairs"):
        apart = bool(rng.random() < _APART_SHARE)
        example = examples.draw_apart() if apart else examples.draw()
        truth = None if apart else relative_truth(items, example.source, example.target)
        candidates = method.candidates(features(example.source), features(example.target))
        kind = int(example.same_stage)
        both = maps(example.source)[kind], maps(example.target)[kind]
        cases.append(case_of(candidates, truth, example.same_stage, both))
    return cases


if __name__ == "__main__":
    main()
