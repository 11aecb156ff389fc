"""Seconds to score runs of the size of NSS, on synthetic data; no points, no map files.

    ./nss python benchmarks/scoring.py [--pairs N] [--fragments N] [--points N]

- `pairs`: evaluation and summary of a log with that many ground-truth edges, without point
  clouds, and the share of the bootstrap in it.
- `fragments`: global RMSE, ours and the official one, of one graph with that many fragments.

Each also as a multiple of what nothing can be faster than: stacking the transforms of the pairs,
and transforming the points of the fragments twice.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from nss_ros.bag import Log
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.benchmark.score import summarize
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import exponential, from_yaw, relative, transform_points
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph
from nss_ros.registration.relative_transform import RelativeTransform

STAGES = 6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=66_000)
    parser.add_argument("--fragments", type=int, default=1500)
    parser.add_argument("--points", type=int, default=20_000, help="points of a fragment")
    arguments = parser.parse_args()

    log = synthetic_log(arguments.fragments, arguments.pairs, 0)
    truth = [edge.T_target_source for edge in log.ground_truth[0].edges]
    floor, _ = timed(lambda: np.stack(truth))
    measured, evaluation = timed(lambda: evaluate(log))
    plain, _ = timed(lambda: summarize(evaluation, Bootstrap(0)))
    whole, _ = timed(lambda: summarize(evaluation))
    print(f"{arguments.pairs} pairs without points: {measured + whole:.2f} s")
    print(f"  evaluate {measured:.2f} s, {measured / floor:.0f} x stacking the transforms")
    print(f"  summarize {plain:.2f} s, and {whole - plain:.2f} s for the bootstrap")

    log = synthetic_log(arguments.fragments, arguments.fragments, arguments.points)
    floor, _ = timed(lambda: [transform_both(fragment) for fragment in log.fragments.values()])
    # Without edges, so that no correspondences are searched.
    bare = PoseGraph(log.ground_truth[0].nodes, (), "graph")
    mapped = Log(log.path, fragments=log.fragments, ground_truth=(bare,), pose_graph=log.pose_graph)
    seconds, evaluation = timed(lambda: evaluate(mapped))
    figures = summarize(evaluation, Bootstrap(0)).overall.map
    print(
        f"{arguments.fragments} fragments of {arguments.points} points: {seconds:.2f} s, "
        f"{seconds / floor:.1f} x transforming all points twice"
    )
    if figures is not None:
        print(f"  global RMSE {figures.global_rmse:.4f} m, official "
              f"{figures.official_global_rmse:.4f} m")  # fmt: skip


def synthetic_log(fragments: int, pairs: int, points: int) -> Log:
    """A run over one area whose estimates are noisy, a third of them wrong."""
    rng = np.random.default_rng(0)
    ids = [FragmentId("1", 1 + i * STAGES // fragments, i) for i in range(fragments)]
    poses = [from_yaw(rng.uniform(-3, 3), (*rng.uniform(0, 60, 2), 1.6)) for _ in range(fragments)]
    drawn = rng.choice(fragments * (fragments - 1) // 2, size=pairs, replace=False)
    rows, columns = np.triu_indices(fragments, 1)
    edges, answers = [], {}
    for i, j in zip(rows[drawn].tolist(), columns[drawn].tolist(), strict=True):
        pair = FragmentPair(ids[i], ids[j])
        truth = relative(poses[i], poses[j])
        kind = EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE
        ratio, change = rng.uniform(0, 1, 2).tolist()
        edges.append(Edge(pair, truth, kind, overlap_ratio=ratio, temporal_change=change))
        scale = 1.0 if rng.random() < 1 / 3 else 0.02
        answers[pair] = RelativeTransform(
            pair, "synthetic", exponential(rng.normal(scale=scale, size=6)) @ truth,
            overlap_probability=rng.random(), confidence=rng.random(),
        )  # fmt: skip
    true_nodes = tuple(
        Node(id_, pose, NodeStatus.PLACED) for id_, pose in zip(ids, poses, strict=True)
    )
    nodes = tuple(
        Node(n.id, n.T_map_fragment @ exponential(rng.normal(scale=0.02, size=6)), n.status)
        for n in true_nodes
    )
    chain = tuple(
        Edge(FragmentPair(a, b), np.eye(4), EdgeKind.SAME_STAGE) for a, b in pairwise(ids)
    )
    cloud = rng.uniform(-4, 4, (points, 3)).astype(np.float32)
    return Log(
        Path("synthetic"),
        fragments={id_: Fragment(id_, cloud.copy()) for id_ in ids} if points else {},
        pairs=tuple(answers),
        relative_transforms=answers,
        ground_truth=(PoseGraph(true_nodes, tuple(edges), "graph"),),
        pose_graph=PoseGraph(nodes, chain, "map", "synthetic"),
    )


def transform_both(fragment: Fragment) -> None:
    """What a displacement cannot do without."""
    for _ in range(2):
        transform_points(np.eye(4), fragment.points.astype(np.float64))


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it gives."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


if __name__ == "__main__":
    main()
