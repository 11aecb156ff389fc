"""Random scenes scored beside the official evaluator.

Runs where NSS_OFFICIAL_EVALUATOR names a checkout of it (the folder that holds the package
`nss_challenge`); it needs scikit-learn and Open3D.
"""

import json
import os
import sys
from argparse import Namespace
from dataclasses import asdict
from itertools import permutations

import numpy as np
import pytest

from nss_ros.benchmark.challenge import score_challenge
from nss_ros.benchmark.clouds import clouds_in
from nss_ros.dataset.challenge import read_graphs
from nss_ros.dataset.ply import write_ply
from nss_ros.errors import NssError
from nss_ros.geometry import exponential, relative

NAMES = {
    "Registration Recall": "recall",
    "Average Translation Error": "translation_error",
    "Average Rotation Error": "rotation_error",
    "Outlier F1": "outlier_f1",
    "Pairwise RMSE": "pairwise_rmse",
    "Global RMSE": "global_rmse",
}
ZERO = np.zeros((4, 4)).tolist()


@pytest.fixture(scope="module")
def official():
    checkout = os.environ.get("NSS_OFFICIAL_EVALUATOR")
    if not checkout:
        pytest.skip("NSS_OFFICIAL_EVALUATOR does not name a checkout of the official evaluator")
    pytest.importorskip("sklearn.neighbors")
    pytest.importorskip("open3d")
    sys.path.insert(0, checkout)
    from nss_challenge import evaluate_registration

    yield evaluate_registration
    sys.path.remove(checkout)


def renamed(graphs):
    """The same graphs in the field names of 2024."""
    names = {
        "global_transform": "tsfm",
        "relative_transform": "tsfm",
        "source_id": "source",
        "target_id": "target",
        "overlap_ratio": "overlap",
    }

    def rename(item):
        return {names.get(key, key): value for key, value in item.items()}

    return [
        {key: [rename(i) for i in value] if isinstance(value, list) else value
         for key, value in graph.items()}
        for graph in graphs
    ]  # fmt: skip


def random_target(rng, number, spots):
    count = int(rng.integers(3, 8))
    chosen = rng.permutation(spots)[:count]
    poses = {int(s): exponential(rng.normal(scale=(1, 1, 1, 0.5, 0.5, 0.5))) for s in chosen}
    outliers = {s for s in poses if rng.random() < (0.25 if number % 2 else 0)}
    if len(outliers) == count:
        outliers.pop()
    text = rng.random() < 0.2
    key = {s: str(s) if text else int(s) for s in poses}
    nodes = [
        {"id": key[s], "name": f"Bldg0_Stage{1 + s % 2}_Spot{s}.ply",
         "global_transform": ZERO if s in outliers else poses[s].tolist()}
        for s in poses
    ]  # fmt: skip
    edges = []
    for source, target in permutations(poses, 2):
        touches = {source, target} & outliers
        if rng.random() < (0.15 if touches else 0.6):
            edges.append(
                {"source_id": key[source], "target_id": key[target],
                 "relative_transform": relative(poses[source], poses[target]).tolist(),
                 "overlap_ratio": rng.random(), "same_stage": bool(rng.random() < 0.6)}
            )  # fmt: skip
    return {"name": f"Bldg0_Scene{number}", "nodes": nodes, "edges": edges}


def random_prediction(rng, target):
    scale = rng.choice([0.0, 1e-9, 0.02, 0.06, 0.2])

    def noisy(transform):
        return (np.array(transform) @ exponential(rng.normal(size=6) * scale)).tolist()

    nodes = []
    for node in target["nodes"]:
        predicted = {"id": node["id"], "global_transform": noisy(node["global_transform"])}
        if rng.random() < 0.1:
            predicted["global_transform"] = ZERO
        if rng.random() < 0.2:
            predicted["anchor"] = bool(rng.random() < 0.7)
        nodes.append(predicted)
    style = rng.integers(6)
    if style == 5:  # a node was forgotten
        nodes.pop(int(rng.integers(len(nodes))))
    if rng.random() < 0.05:  # a node too many shifts the outlier mask
        nodes.insert(int(rng.integers(len(nodes))), {"id": 99, "global_transform": ZERO})
    prediction = {"name": target["name"], "nodes": nodes}
    if style == 0:
        return prediction
    edges = [
        {**{k: e[k] for k in ("source_id", "target_id", "same_stage")},
         "relative_transform": noisy(e["relative_transform"])}
        for e in target["edges"]
    ]  # fmt: skip
    if style in (2, 3):
        edges = [e for e in edges if rng.random() < 0.7]
    if style in (3, 4):
        for edge in edges:
            if rng.random() < 0.15:
                edge["relative_transform"] = None
            elif rng.random() < 0.1:
                del edge["relative_transform"]
    if edges and rng.random() < 0.2:  # predicted twice: the last one counts
        edges.append(
            {**edges[0], "relative_transform": noisy(target["edges"][0]["relative_transform"])}
        )
    return {**prediction, "edges": edges}


def figures(official_metrics):
    """Official figures per scene and subset, and their mean over scenes."""
    scenes = {
        name: {s: {NAMES[k]: v for k, v in values.items()} for s, values in subsets.items()}
        for name, subsets in official_metrics.items()
    }
    overall = {
        subset: {
            name: np.nanmean([scene[subset][name] for scene in scenes.values()])
            for name in next(iter(scenes.values()))[subset]
        }
        for subset in ("All", "Same-Stage", "Cross-Stage")
    }
    return {**scenes, "overall": overall}


@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")
@pytest.mark.parametrize("with_points", [True, False])
def test_random_scenes(official, tmp_path, with_points):
    rng = np.random.default_rng(7)
    spots = np.arange(10)
    base = rng.uniform(-0.6, 0.6, (150, 3))
    for spot in spots:
        points = base + rng.normal(scale=0.03, size=base.shape)
        write_ply(
            tmp_path / f"Bldg0_Stage{1 + spot % 2}_Spot{spot}.ply",
            {axis: points[:, k] for k, axis in enumerate("xyz")},
        )
    compared = refused = 0
    for case in range(100):
        target = [random_target(rng, i, spots) for i in range(int(rng.integers(1, 4)))]
        prediction = [random_prediction(rng, graph) for graph in target]
        if case % 3 == 0:
            target, prediction = renamed(target), renamed(prediction)
        paths = [tmp_path / f"{case}_target.json", tmp_path / f"{case}_prediction.json"]
        for path, graphs in zip(paths, (target, prediction), strict=True):
            path.write_text(json.dumps(graphs))
        threshold = float(rng.choice([0.05, 0.1, 0.2]))
        arguments = Namespace(
            target=str(paths[0]),
            prediction=str(paths[1]),
            translation_threshold=threshold,
            rotation_threshold=10,
            point_cloud_dir=str(tmp_path) if with_points else None,
        )
        clouds = clouds_in(tmp_path) if with_points else None
        graphs = [read_graphs(path) for path in paths]
        try:
            expected = figures(official.evaluate(arguments))
        except Exception:
            with pytest.raises(NssError):
                score_challenge(*graphs, clouds, threshold)
            refused += 1
            continue
        score = score_challenge(*graphs, clouds, threshold)
        for name, subsets in {**score.scenes, "overall": score.overall}.items():
            for subset, metrics in subsets.items():
                for figure, value in expected[name][subset].items():
                    assert asdict(metrics)[figure] == pytest.approx(value, abs=1e-9, nan_ok=True), (
                        case,
                        name,
                        subset,
                        figure,
                    )
        compared += 1
    assert compared > 50
    assert refused > 5
