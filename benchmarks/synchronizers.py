"""How well synchronizers place fragments on simulated graphs, at several levels of outliers.

    ./nss python benchmarks/synchronizers.py [--graphs N] [--seed N] [--methods NAME...]
        [--posegraphnet-weights NAME=FILE...] [--json FILE]

The graphs are those of `nss_ros.multiway.posegraphnet.simulated_graph`, of seeds that training
never draws: level tripods on a floor, one relative transform per pair, wrong ones at random and
aliased ones. Recall is that of all pairs that were asked for, wrong ones included, from the poses
of the nodes: within 10 degrees and 0.2 m of the truth. Pairs whose fragments are not placed in one
map count as missed.

- `tree`: a spanning tree by triangle support, from which `posegraphnet` starts.
- `right edges`: `choi` with the right measurements only: what can be reached at all.
- `posegraphnet (NAME)`: with the weights of a file, for instance the published ones.

Each level has graphs of its own, the same for all methods. Intervals are 95 % of a bootstrap over
the graphs.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from nss_ros.benchmark.metrics import rotation_error, successes, translation_error
from nss_ros.cli.progress import progress_bar
from nss_ros.config import MultiwayConfig
from nss_ros.errors import NssError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, relative
from nss_ros.multiway.posegraphnet.simulated_graph import (
    GraphSettings,
    SimulatedGraph,
    simulated_graph,
)
from nss_ros.multiway.posegraphnet.start import tree_poses
from nss_ros.multiway.spanning_tree import Closeness, components
from nss_ros.multiway.synchronizer import load_synchronizer
from nss_ros.table import Align, Column, Table

METHODS = ("choi", "submaps", "posegraphnet")
#: Keeps the seeds of held-out graphs apart from those of training.
HELD_OUT = 1
RESAMPLINGS = 2000

_USUAL = GraphSettings()
LEVELS = {
    "few, random": replace(
        _USUAL, right_within=(0.8, 0.9), right_across=(0.6, 0.8), aliased=(0.0, 0.0)
    ),
    "many, random": replace(
        _USUAL, right_within=(0.5, 0.6), right_across=(0.2, 0.4), aliased=(0.0, 0.0)
    ),
    "few, aliased": replace(
        _USUAL, right_within=(0.8, 0.9), right_across=(0.6, 0.8), aliased=(0.8, 0.8)
    ),
    "many, aliased": replace(
        _USUAL, right_within=(0.5, 0.6), right_across=(0.2, 0.4), aliased=(0.8, 0.8)
    ),
    "mixed": _USUAL,
    "mixed, large": replace(_USUAL, fragments=(120, 160)),
}


class Figure(NamedTuple):
    """What a method reaches on the graphs of a level."""

    level: str
    method: str
    recalls: list[float]
    seconds: float


#: Component and `T_map_fragment` of the placed fragments.
Places = dict[FragmentId, tuple[int, Transform]]
Method = Callable[[SimulatedGraph], Places]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--graphs", type=int, default=20, help="of each level")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--methods", nargs="*", default=METHODS, help="registered names")
    parser.add_argument(
        "--posegraphnet-weights", nargs="*", default=[], metavar="NAME=FILE", help="beside ours"
    )
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    arguments = parser.parse_args()
    try:
        methods = _methods(arguments.methods, arguments.posegraphnet_weights)
        figures = measure(methods, arguments.graphs, arguments.seed)
    except NssError as error:
        sys.exit(f"error: {error}")
    console = Console()
    console.print(table(figures, arguments.seed).to_rich())
    console.print("./nss python " + " ".join(sys.argv))
    if arguments.json:
        arguments.json.write_text(json.dumps([each._asdict() for each in figures], indent=2) + "\n")


def _methods(names: Sequence[str], weights: Sequence[str]) -> dict[str, Method]:
    config = MultiwayConfig()
    methods: dict[str, Method] = {"tree": by_tree}
    for name in names:
        methods[name] = by_synchronizer(config.model_copy(update={"synchronizer": name}))
    for each in weights:
        label, _, path = each.partition("=")
        chosen = {"synchronizer": "posegraphnet", "posegraphnet_weights": path}
        methods[f"posegraphnet ({label})"] = by_synchronizer(config.model_copy(update=chosen))
    choi = by_synchronizer(config.model_copy(update={"synchronizer": "choi"}))
    methods["right edges"] = lambda graph: choi(only_right(graph))
    return methods


def by_synchronizer(config: MultiwayConfig) -> Method:
    """Places by the synchronizer of a configuration."""
    synchronizer = load_synchronizer(config)

    def places(graph: SimulatedGraph) -> Places:
        nodes = synchronizer.synchronize(graph.fragments, graph.measurements).poses()
        return {id_: (node.component, node.T_map_fragment) for id_, node in nodes.items()}

    return places


def by_tree(graph: SimulatedGraph) -> Places:
    """Places by a spanning tree of each component."""
    config = MultiwayConfig()
    close = Closeness(config.loop_translation, float(np.radians(config.loop_rotation)))
    poses = tree_poses(graph.fragments, graph.measurements, close)
    parts = components(graph.fragments, graph.measurements)
    return {id_: (n, poses[id_]) for n, members in enumerate(parts) for id_ in members}


def only_right(graph: SimulatedGraph) -> SimulatedGraph:
    """A graph without its wrong measurements."""
    pairs = zip(graph.measurements, graph.right, strict=True)
    kept = tuple(m for m, is_right in pairs if is_right)
    return replace(graph, measurements=kept, right=np.ones(len(kept), dtype=bool))


def recall(places: Places, graph: SimulatedGraph) -> float:
    """Share of the pairs that were asked for that are within the limits, percent."""
    found, truths = [], []
    for pair in (m.pair for m in graph.measurements):
        one, other = places.get(pair.source), places.get(pair.target)
        if one and other and one[0] == other[0]:
            found.append(relative(one[1], other[1]))
            truths.append(relative(graph.poses[pair.source], graph.poses[pair.target]))
    if not found:
        return 0.0
    both = np.array(truths), np.array(found)
    hits = successes(rotation_error(*both), translation_error(*both))
    return 100 * int(np.count_nonzero(hits)) / len(graph.measurements)


def measure(methods: dict[str, Method], count: int, seed: int) -> list[Figure]:
    """Recall of every graph and seconds per graph, for each level and method."""
    figures = []
    with progress_bar() as bar:
        for number, (level, settings) in enumerate(LEVELS.items()):
            graphs = [
                simulated_graph(np.random.default_rng((HELD_OUT, seed, number, i)), settings)
                for i in range(count)
            ]
            for name, method in methods.items():
                begin = time.perf_counter()
                places = [
                    method(graph) for graph in bar.track(graphs, description=f"{level}: {name}")
                ]
                seconds = (time.perf_counter() - begin) / count
                recalls = [recall(*each) for each in zip(places, graphs, strict=True)]
                figures.append(Figure(level, name, recalls, seconds))
    return figures


def table(figures: Sequence[Figure], seed: int) -> Table:
    """A row for each level and method."""
    columns = (
        Column("Outliers", align=Align.LEFT),
        Column("Method", align=Align.LEFT),
        Column("Recall", "%", ".1f"),
        Column("95 % interval", align=Align.RIGHT),
        Column("Time", "s", ".2f"),
    )
    rows = tuple(
        (each.level, each.method, float(np.mean(each.recalls)), interval(each, seed), each.seconds)
        for each in figures
    )
    return Table(
        "Recall of synchronizers on simulated graphs",
        columns,
        rows,
        f"{len(figures[0].recalls)} graphs a level; pairs within 10 deg and 0.2 m by node poses",
    )


def interval(figure: Figure, seed: int) -> str:
    """Bootstrap interval of a mean over graphs."""
    rng = np.random.default_rng(seed)
    recalls = np.array(figure.recalls)
    means = recalls[rng.integers(0, len(recalls), (RESAMPLINGS, len(recalls)))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return f"{low:.1f}-{high:.1f}"


if __name__ == "__main__":
    main()
