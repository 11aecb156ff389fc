"""Trains the weights of the gravity method from simulated datasets.

    ./nss python -m nss_ros.registration.gravity.train DATASET... --comparison DATASET...
        --verifier DATASET... -o FILE

With `--start` the network of other weights is trained further, for instance on sites of one's own.
The second look and the verifier learn from datasets of their own each: hypotheses must be as good
and as bad, and second looks as sharp, as on sites that have not been seen.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import cache, lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import Progress

from nss_ros.cli.progress import progress_bar
from nss_ros.config import RegistrationConfig
from nss_ros.errors import NssError
from nss_ros.geometry import Transform
from nss_ros.registration.gravity.comparison_training import (
    POSES,
    PosedPair,
    train_comparison,
)
from nss_ros.registration.gravity.method import Gravity, GravityFeatures
from nss_ros.registration.gravity.training import TrainingConfig, train
from nss_ros.registration.gravity.training_data import (
    Example,
    ExampleSource,
    Item,
    read_items,
    relative_truth,
)
from nss_ros.registration.gravity.verifier_training import Case, case_of, train_verifier
from nss_ros.registration.gravity.weights import Networks, load_network, save_weights
from nss_ros.registration.gravity.wide import is_wide

# Shares of the pairs that do not overlap.
_VERIFIER_APART, _COMPARISON_APART = 0.2, 0.1
# Share of those of different stages among the others.
_COMPARISON_DIFFERENT = 0.75
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
        help="datasets of other seeds, for the verifier",
    )
    parser.add_argument(
        "--comparison",
        type=Path,
        nargs="+",
        required=True,
        help="datasets of further seeds, for the second look",
    )
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--start", type=Path, help="weights whose network is trained further")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--learning-rate", type=float, default=2e-3, help="the largest one")
    parser.add_argument("--verifier-pairs", type=int, default=3000)
    parser.add_argument("--comparison-pairs", type=int, default=5600)
    parser.add_argument("--comparison-steps", type=int, default=8000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0, help="processes that read; 0: all cores")
    parser.add_argument(
        "--threads", type=int, default=1, help="more are faster and give other last digits"
    )
    arguments = parser.parse_args()
    groups = arguments.datasets, arguments.comparison, arguments.verifier
    for one, other in combinations(groups, 2):
        both = {each.resolve() for each in one} & {each.resolve() for each in other}
        if both:
            parser.error(
                "the network, the second look and the verifier must not learn from the same "
                f"dataset: {min(both)}"
            )
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
        method = Gravity(config, networks)
        items = read_items(arguments.comparison, config, arguments.workers)
        posed = posed_pairs(method, items, arguments.comparison_pairs, arguments.seed, bar)
        steps = arguments.comparison_steps
        task = bar.add_task("second look", total=steps)
        for step, loss in train_comparison(networks.comparison, posed, steps, arguments.seed):
            bar.update(task, completed=step + 1, description=f"second look, loss {loss:.2f}")
        items = read_items(arguments.verifier, config, arguments.workers)
        cases = verifier_cases(method, items, arguments.verifier_pairs, arguments.seed, bar)
    loss = train_verifier(networks.verifier, cases, arguments.seed)
    print(f"verifier: loss {loss:.3f}")
    save_weights(arguments.output, networks)


def posed_pairs(
    method: Gravity, items: list[Item], count: int, seed: int, bar: Progress
) -> list[PosedPair]:
    """Poses of the search of pairs drawn from prepared fragments, but of those with wide maps."""
    features = _features(method, items)

    @cache
    def maps(number: int) -> NDArray[np.float16]:
        found = features(number).maps
        assert found is not None
        return found.astype(np.float16)

    examples = ExampleSource(items, seed, _COMPARISON_DIFFERENT)
    rng = np.random.default_rng(seed)
    pairs = []
    for _ in bar.track(range(count), description="pairs to compare"):
        example, truth = _drawn(examples, rng, _COMPARISON_APART)
        source, target = features(example.source), features(example.target)
        kind = int(example.same_stage)
        both = maps(example.source)[kind], maps(example.target)[kind]
        if not is_wide(*both):
            pairs.append(PosedPair.of(both, method.search(source, target, POSES).peaks, truth))
    return pairs


def verifier_cases(
    method: Gravity, items: list[Item], count: int, seed: int, bar: Progress
) -> list[Case]:
    """Hypotheses of pairs drawn from prepared fragments, with what is right."""
    features = _features(method, items)
    examples, rng = ExampleSource(items, seed), np.random.default_rng(seed)
    cases = []
    for _ in bar.track(range(count), description="pairs to verify"):
        example, truth = _drawn(examples, rng, _VERIFIER_APART)
        candidates = method.candidates(features(example.source), features(example.target))
        cases.append(case_of(candidates, truth, example.same_stage))
    return cases


def _features(method: Gravity, items: list[Item]) -> Callable[[int], GravityFeatures]:
    @lru_cache(_CACHE)
    def features(number: int) -> GravityFeatures:
        return method.prepare_scan(items[number].scan)

    return features


def _drawn(
    examples: ExampleSource, rng: np.random.Generator, apart: float
) -> tuple[Example, Transform | None]:
    """A pair, and its ground truth; None for one that does not overlap."""
    if rng.random() < apart:
        return examples.draw_apart(), None
    example = examples.draw()
    return example, relative_truth(examples.items, example.source, example.target)


if __name__ == "__main__":
    main()
