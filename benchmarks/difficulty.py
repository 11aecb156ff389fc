"""How hard a dataset is: recall of FPFH on a sample of its pairs, beside the paper's figures.

    ./nss python benchmarks/difficulty.py DATASET [--pairs N] [--seed N] [--workers N]

Two methods register the same pairs, drawn at random from those with an overlap ratio of at least
0.1: the test pairs of the split cross_area, or all selected pairs of a dataset without splits.

- `plain`: Open3D's FPFH and RANSAC as benchmarks of learned features run it, without knowledge of
  gravity and without ICP. With voxel size v = 0.1 m: normals from 30 neighbours within 2 v, FPFH
  from 100 neighbours within 5 v; samples of 3 correspondences, edge lengths within 10 %, inliers
  within 1.5 v; 50,000 iterations (as Predator and GeoTransformer), confidence 0.999.
- `fpfh_ransac`: our own with its default settings, gravity and ICP.

Recall counts pairs within 10 degrees and 0.2 m of the ground truth, failures included. The
intervals are 95 % of a bootstrap over the pairs; without a success among n pairs there is no
interval, and the true recall is below 300 / n percent at the same confidence.
"""

from __future__ import annotations

import argparse
import os
import pickle
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from nss_ros.fragment import Fragment, FragmentId, FragmentPair
    from nss_ros.geometry import Transform
    from nss_ros.table import Table

SPLIT, SUBSET = "cross_area", "test"
MIN_OVERLAP = 0.1
BINS = (0.1, 0.2, 0.3, 0.5)
METHODS = ("plain", "fpfh_ransac")
PAPER = ("paper, FPFH *", 32.9, 1.1)

VOXEL_SIZE = 0.1
NORMAL_RADIUS, NORMAL_NEIGHBOURS = 2 * VOXEL_SIZE, 30
FEATURE_RADIUS, FEATURE_NEIGHBOURS = 5 * VOXEL_SIZE, 100
INLIER_DISTANCE = 1.5 * VOXEL_SIZE
EDGE_SIMILARITY = 0.9
ITERATIONS, CONFIDENCE = 50_000, 0.999
RESAMPLINGS = 10_000


class Candidate(NamedTuple):
    """A pair with its ground truth."""

    pair: FragmentPair
    overlap_ratio: float
    T_target_source: Transform


class Trial(NamedTuple):
    """One call of a worker: a pair, and where the features of its fragments lie."""

    candidate: Candidate
    folder: Path
    seed: int


class Outcome(NamedTuple):
    """Whether each method was right, and how long it took, in the order of METHODS."""

    right: tuple[bool, ...]
    seconds: tuple[float, ...]


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--pairs", type=int, default=200, help="most pairs of each kind")
    parser.add_argument("--seed", type=int, default=0, help="of the sample and of RANSAC")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    # Open3D reads it when it loads; with more threads its RANSAC is not reproducible.
    os.environ["OMP_NUM_THREADS"] = "1"

    from rich.console import Console

    from nss_ros.errors import NssError

    console = Console()
    try:
        chosen = sample(candidates(arguments.dataset), arguments.pairs, arguments.seed)
        for table in measure(arguments.dataset, chosen, arguments.seed, arguments.workers):
            console.print(table.to_rich())
    except NssError as error:
        sys.exit(f"error: {error}")
    console.print("./nss python " + " ".join(sys.argv))


def candidates(folder: Path) -> list[Candidate]:
    """The pairs of a dataset that may be drawn, in its order."""
    from nss_ros.dataset.folder import PAIRS_NAME, SPLIT_FOLDER, DatasetFolder
    from nss_ros.dataset.pairs import read_pairs
    from nss_ros.errors import InputError
    from nss_ros.geometry import relative

    dataset = DatasetFolder(folder)
    split = folder / SPLIT_FOLDER / SPLIT / f"{SUBSET}.csv"
    if not (folder / PAIRS_NAME).exists():
        raise InputError(f"{folder} has no pairs yet: run 'nss pairs {folder}' first.")
    table = read_pairs(split if split.exists() else folder / PAIRS_NAME)
    table = table.take(table.selected & (table.overlap_ratio >= MIN_OVERLAP))
    if len(table) == 0:
        raise InputError(f"{folder} has no selected pair to register: run 'nss pairs {folder}'.")
    poses = dataset.poses()
    return [
        Candidate(pair, float(overlap), relative(poses[pair.source], poses[pair.target]))
        for pair, overlap in zip(table.pairs, table.overlap_ratio, strict=True)
    ]


def sample(pairs: list[Candidate], count: int, seed: int) -> list[Candidate]:
    """At most `count` same-stage and `count` different-stage pairs, uniform among each kind."""
    import numpy as np

    drawn = []
    for kind in (True, False):
        side = [each for each in pairs if each.pair.same_stage is kind]
        rng = np.random.default_rng((seed, kind))
        order = rng.choice(len(side), min(count, len(side)), replace=False)
        drawn += [side[i] for i in sorted(order)]
    return drawn


def measure(folder: Path, chosen: list[Candidate], seed: int, workers: int) -> list[Table]:
    """Register the pairs with both methods; recall by kind, and by overlap ratio."""
    from nss_ros.cli.progress import progress_bar
    from nss_ros.parallel import run

    fragments = sorted({id_ for each in chosen for id_ in (each.pair.source, each.pair.target)})
    with TemporaryDirectory() as cache, progress_bar() as bar:
        calls = [(folder, id_, Path(cache)) for id_ in fragments]
        list(bar.track(run(describe, calls, workers), len(calls), description="describing"))
        trials = [Trial(each, Path(cache), seed) for each in chosen]
        answers = bar.track(run(register, trials, workers), len(trials), description="registering")
        outcomes = list(answers)
    return [
        kind_table(folder.name, chosen, outcomes, seed),
        overlap_table(folder.name, chosen, outcomes),
    ]


def describe(call: tuple[Path, FragmentId, Path]) -> None:
    """Leave the features of a fragment for both methods in a cache."""
    from nss_ros.config import RegistrationConfig
    from nss_ros.dataset.folder import DatasetFolder
    from nss_ros.registration.method import load_method

    folder, id_, cache = call
    fragment = DatasetFolder(folder).fragment(id_)
    ours = load_method(RegistrationConfig(method=METHODS[1])).prepare(fragment)
    with (cache / str(id_)).open("wb") as file:
        pickle.dump((plain_features(fragment), ours), file)


def register(trial: Trial) -> Outcome:
    """Register one pair with both methods."""
    from nss_ros.config import RegistrationConfig
    from nss_ros.registration.method import load_method
    from nss_ros.registration.pair import register_pair
    from nss_ros.registration.seed import pair_seed

    pair = trial.candidate.pair
    sources, targets = (
        pickle.loads((trial.folder / str(id_)).read_bytes()) for id_ in (pair.source, pair.target)
    )
    begin = time.perf_counter()
    plain = plain_ransac(sources[0], targets[0], pair_seed(pair, trial.seed))
    seconds = time.perf_counter() - begin
    config = RegistrationConfig(method=METHODS[1], seed=trial.seed)
    answer = register_pair(load_method(config), sources[1], targets[1], pair, config)
    truth = trial.candidate.T_target_source
    return Outcome(
        (right(truth, plain), answer.ok and right(truth, answer.T_target_source)),
        (seconds, answer.compute_time),
    )


def right(truth: Transform, estimate: Transform) -> bool:
    """Whether an estimate is a success by the paper's limits."""
    from nss_ros.benchmark.metrics import rotation_error, successes, translation_error

    return bool(successes(rotation_error(truth, estimate), translation_error(truth, estimate)))


def plain_features(fragment: Fragment) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Voxelised points (n, 3) and their FPFH (33, n), float64."""
    import numpy as np
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(fragment.points.astype(np.float64)))
    cloud = cloud.voxel_down_sample(VOXEL_SIZE)
    search = o3d.geometry.KDTreeSearchParamHybrid
    cloud.estimate_normals(search(NORMAL_RADIUS, NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    feature: Any = o3d.pipelines.registration.compute_fpfh_feature(
        cloud, search(FEATURE_RADIUS, FEATURE_NEIGHBOURS)
    )
    return np.asarray(cloud.points), np.asarray(feature.data)


def plain_ransac(
    source: tuple[NDArray[np.float64], NDArray[np.float64]],
    target: tuple[NDArray[np.float64], NDArray[np.float64]],
    seed: int,
) -> Transform:
    """`T_target_source` by Open3D; the same on one thread for the same seed."""
    import numpy as np
    import open3d as o3d

    registration: Any = o3d.pipelines.registration
    clouds, features = [], []
    for points, descriptors in (source, target):
        clouds.append(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
        features.append(registration.Feature())
        features[-1].data = descriptors
    o3d.utility.random.seed(seed % 2**31)
    result = registration.registration_ransac_based_on_feature_matching(
        *clouds,
        *features,
        False,
        INLIER_DISTANCE,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(EDGE_SIMILARITY),
            registration.CorrespondenceCheckerBasedOnDistance(INLIER_DISTANCE),
        ],
        registration.RANSACConvergenceCriteria(ITERATIONS, CONFIDENCE),
    )
    return np.array(result.transformation)


def kind_table(name: str, chosen: list[Candidate], outcomes: list[Outcome], seed: int) -> Table:
    """Recall with intervals of same-stage and different-stage pairs."""
    from nss_ros.table import Align, Column, Table

    kinds = [each.pair.same_stage for each in chosen]
    counts = (kinds.count(True), kinds.count(False))
    rows: list[tuple[str | float | None, ...]] = []
    for number, method in enumerate(METHODS):
        cells: list[str | float | None] = [method]
        for kind in (True, False):
            hits = [
                o.right[number] for o, same in zip(outcomes, kinds, strict=True) if same is kind
            ]
            cells += [100 * mean(hits), interval(hits, seed)]
        rows.append((*cells, mean([o.seconds[number] for o in outcomes])))
    rows.append((PAPER[0], PAPER[1], None, PAPER[2], None, None))
    return Table(
        f"Difficulty of {name}: {counts[0]} same-stage and {counts[1]} different-stage pairs",
        (
            Column("method", align=Align.LEFT),
            Column("same stage", "%", ".1f"),
            Column("95 %"),
            Column("different stages", "%", ".1f"),
            Column("95 %"),
            Column("per pair", "s", ".2f"),
        ),
        tuple(rows),
        "Recall within 10 deg and 0.2 m. * On other data: the cross_area split of NSS.",
    )


def overlap_table(name: str, chosen: list[Candidate], outcomes: list[Outcome]) -> Table:
    """Recall by overlap ratio."""
    from itertools import pairwise

    from nss_ros.table import Align, Column, Table

    bins = list(pairwise((*BINS, float("inf"))))
    rows: list[tuple[str, ...]] = []
    for kind, title in ((True, "same stage"), (False, "different stages")):
        for number, method in enumerate(METHODS):
            cells = []
            for low, high in bins:
                hits = [
                    outcome.right[number]
                    for each, outcome in zip(chosen, outcomes, strict=True)
                    if each.pair.same_stage is kind and low <= each.overlap_ratio < high
                ]
                cells.append(f"{100 * mean(hits):.1f} ({len(hits)})" if hits else "-")
            rows.append((f"{title}, {method}", *cells))
    names = [f"{low:g}-{high:g}" for low, high in bins[:-1]]
    return Table(
        f"Recall of {name} by overlap ratio, percent (pairs)",
        (
            Column("between, by", align=Align.LEFT),
            *(Column(each) for each in names),
            Column(f"from {bins[-1][0]:g}"),
        ),
        tuple(rows),
    )


def mean(values: list[Any]) -> float:
    """NaN of nothing."""
    return sum(values) / len(values) if values else float("nan")


def interval(hits: list[bool], seed: int) -> str:
    """The central 95 % of resampled recalls, percent."""
    import numpy as np

    if not hits:
        return "-"
    # Hits in a resampling with replacement are binomially distributed.
    rng = np.random.default_rng(seed)
    resampled = rng.binomial(len(hits), sum(hits) / len(hits), RESAMPLINGS) * 100 / len(hits)
    low, high = np.percentile(resampled, (2.5, 97.5))
    return f"{low:.1f}-{high:.1f}"


if __name__ == "__main__":
    main()
