"""Seconds and recall per pair of each registration method on one bag, in one process.

    ./nss python benchmarks/registration.py [bag] [--pairs N] [--threads N]

Recall counts pairs within 10 degrees and 0.2 m of the ground truth, failures included; features
are computed once per fragment and timed apart.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from nss_ros.fragment import Fragment, FragmentId, FragmentPair
    from nss_ros.geometry import Transform

BAG = Path(__file__).parents[1] / "bags" / "three_stages"


class Answer(NamedTuple):
    """What became of one pair."""

    same_stage: bool
    right: bool
    failed: bool
    seconds: float


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", nargs="?", type=Path, default=BAG)
    parser.add_argument("--pairs", type=int, help="take this many pairs, evenly from all")
    parser.add_argument("--threads", type=int, default=1, help="threads of each library")
    arguments = parser.parse_args()
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = str(arguments.threads)
    measure(arguments.bag, arguments.pairs)


def measure(bag: Path, count: int | None) -> None:
    """Register a bag's pairs with every installed method and print a table."""
    # The libraries read their thread counts when they load, so after these are set.
    from rich.console import Console
    from rich.table import Table

    from nss_ros.bag import read_log
    from nss_ros.registration.method import method_names

    log = read_log(bag)
    truth = {edge.pair: edge.T_target_source for graph in log.ground_truth for edge in graph.edges}
    pairs = [pair for pair in log.pairs if pair in truth]
    pairs = pairs[:: max(1, len(pairs) // count)][:count] if count else pairs
    console = Console()
    same = sum(pair.same_stage for pair in pairs)
    table = Table(
        title=f"Registration of {bag.name}: {same} same-stage, {len(pairs) - same} different-stage "
        "pairs",
        caption="seconds per fragment and per pair; recall in percent",
    )
    columns = ("s/scan", "s/pair", "slowest", "failed", "same", "different", "all")
    table.add_column("method", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right")
    for name in method_names():
        seconds, answers = _answers(name, log.fragments, pairs, truth)
        per_pair = [answer.seconds for answer in answers]
        table.add_row(
            name,
            f"{seconds:.2f}",
            f"{sum(per_pair) / len(per_pair):.2f}",
            f"{max(per_pair):.2f}",
            f"{sum(answer.failed for answer in answers)}",
            _recall([a for a in answers if a.same_stage]),
            _recall([a for a in answers if not a.same_stage]),
            _recall(answers),
        )
    console.print(table)
    console.print("./nss python " + " ".join(sys.argv))


def _answers(
    name: str,
    fragments: dict[FragmentId, Fragment],
    pairs: list[FragmentPair],
    truth: dict[FragmentPair, Transform],
) -> tuple[float, list[Answer]]:
    """Seconds per fragment, and the answers to all pairs, of one method."""
    import open3d  # noqa: F401  # loading it is no part of the first fragment

    from nss_ros.benchmark.metrics import rotation_error, successes, translation_error
    from nss_ros.config import RegistrationConfig
    from nss_ros.registration.method import load_method
    from nss_ros.registration.pair import register_pair

    config = RegistrationConfig(method=name)
    method = load_method(config)
    needed = sorted({id_ for pair in pairs for id_ in (pair.source, pair.target)})
    begin = time.perf_counter()
    features = {id_: method.prepare(fragments[id_]) for id_ in needed}
    seconds = (time.perf_counter() - begin) / len(needed)
    answers = []
    for pair in pairs:
        result = register_pair(method, features[pair.source], features[pair.target], pair, config)
        right = result.ok and bool(
            successes(
                rotation_error(truth[pair], result.T_target_source),
                translation_error(truth[pair], result.T_target_source),
            )
        )
        answers.append(Answer(pair.same_stage, right, not result.ok, result.compute_time))
    return seconds, answers


def _recall(answers: list[Answer]) -> str:
    if not answers:
        return "-"
    right = sum(answer.right for answer in answers)
    return f"{100 * right / len(answers):.1f}"


if __name__ == "__main__":
    main()
