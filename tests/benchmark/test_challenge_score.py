"""Official figures of the challenge, and where the official evaluator would fail."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from nss_ros.benchmark.challenge import score_challenge
from nss_ros.benchmark.clouds import clouds_in
from nss_ros.dataset.challenge import ChallengeEdge, ChallengeGraph, ChallengeNode, read_graphs
from nss_ros.dataset.ply import write_ply
from nss_ros.errors import FormatError, InputError
from nss_ros.geometry import exponential, relative

NAMES = {
    "Registration Recall": "recall",
    "Average Translation Error": "translation_error",
    "Average Rotation Error": "rotation_error",
    "Outlier F1": "outlier_f1",
    "Pairwise RMSE": "pairwise_rmse",
    "Global RMSE": "global_rmse",
}


@pytest.mark.parametrize("threshold", [0.1, 0.2])
@pytest.mark.parametrize(
    ("target", "prediction"),
    [
        ("mock_target_2025", "mock_prediction_2025"),
        ("mock_target_2024", "mock_prediction_2024"),
        ("mock_target_2025", "prediction_small_noise_2025"),
        ("mock_target_2025", "prediction_with_edges_2025"),
    ],
)
def test_figures_equal_the_official_evaluator(shared_data, target, prediction, threshold):
    folder = shared_data / "nss_challenge"
    expected = json.loads((folder / "expected.json").read_text())
    score = score_challenge(
        read_graphs(folder / f"{target}.json"),
        read_graphs(folder / f"{prediction}.json"),
        clouds_in(folder / "pointclouds"),
        threshold,
    )
    scenes = expected[f"{target}|{prediction}|{threshold}"]
    assert score.scenes.keys() == scenes.keys()
    for name, subsets in scenes.items():
        for subset, figures in subsets.items():
            ours = asdict(score.scenes[name][subset])
            for figure, value in figures.items():
                assert ours[NAMES[figure]] == pytest.approx(value, abs=1e-9), (subset, figure)


def node(id_, transform, **more):
    return ChallengeNode(id_, f"Bldg0_Stage1_Spot{id_}.ply", transform, **more)


@pytest.fixture
def scene(tmp_path):
    """Three placed nodes and an outlier, with edges and clouds; the perfect prediction."""
    rng = np.random.default_rng(1)
    poses = [exponential(rng.normal(size=6)) for _ in range(3)]
    for i in range(4):
        points = rng.uniform(-0.5, 0.5, (200, 3))
        write_ply(
            tmp_path / f"Bldg0_Stage1_Spot{i}.ply",
            {axis: points[:, k] for k, axis in enumerate("xyz")},
        )
    nodes = (*(node(i, pose) for i, pose in enumerate(poses)), node(3, np.zeros((4, 4))))
    edges = tuple(
        ChallengeEdge(s, t, relative(poses[s], poses[t]), same_stage=s == 0)
        for s, t in ((0, 1), (1, 2), (0, 2))
    )
    return ChallengeGraph("scene", nodes, edges), clouds_in(tmp_path)


def test_the_target_itself_is_perfect(scene):
    target, clouds = scene
    score = score_challenge([target], [target], clouds)
    for metrics in score.scenes["scene"].values():
        assert metrics.recall == 100.0
        assert metrics.outlier_f1 == 100.0
        assert metrics.translation_error < 1e-9
        assert metrics.rotation_error < 1e-5
        assert metrics.global_rmse < 1e-9
    assert score.overall == score.scenes["scene"]
    assert not score.notes


def test_without_points_there_is_no_rmse(scene):
    metrics = score_challenge([scene[0]], [scene[0]]).overall["All"]
    assert metrics.pairwise_rmse is None
    assert metrics.global_rmse is None


def test_a_common_motion_of_all_poses_does_not_matter(scene):
    target, clouds = scene
    motion = exponential([5, -3, 1, 0.3, 2, -1])
    nodes = tuple(
        replace(n, transform=motion @ n.transform if not n.outlier else n.transform)
        for n in target.nodes
    )
    metrics = score_challenge([target], [ChallengeGraph("scene", nodes)], clouds).overall["All"]
    assert metrics.recall == 100.0
    assert metrics.global_rmse < 1e-9


def test_scenes_are_matched_by_position_and_it_is_said(scene):
    target, _ = scene
    score = score_challenge([target], [replace(target, name="other")])
    assert "matched by position" in score.notes[0]


def with_pose(graph, index, transform):
    nodes = list(graph.nodes)
    nodes[index] = replace(nodes[index], transform=transform)
    return replace(graph, nodes=tuple(nodes))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: ([t], []), "1 scenes, but the prediction has 0"),
        (lambda _: ([], []), "holds no pose graph"),
        (lambda t: ([replace(t, edges=None)], [t]), "has no edges"),
        (lambda t: ([t], [with_pose(t, 0, np.zeros((4, 4)))]), "is the anchor"),
        (
            lambda t: ([t], [replace(with_pose(t, 2, np.zeros((4, 4))), edges=None)]),
            "target of an edge",
        ),
        (lambda t: ([t], [replace(with_pose(t, 1, None), edges=None)]), "no 'global_transform'"),
        (lambda t: ([t], [replace(t, nodes=t.nodes[:2])]), "has 4 nodes, but .* 2"),
        (lambda t: ([t], [replace(t, nodes=())]), "has 4 nodes, but .* 0"),
        (
            lambda t: ([replace(t, nodes=t.nodes[:3])], [replace(t, nodes=())]),
            "no predicted node is an inlier",
        ),
        (
            lambda t: ([t], [replace(t, edges=(replace(t.edges[0], same_stage=None),))]),
            "lacks 'same_stage'",
        ),
        (
            lambda t: ([replace(t, edges=(replace(t.edges[0], transform=None),))], [t]),
            "no 'relative_transform'",
        ),
        (
            lambda t: ([replace(t, edges=(replace(t.edges[0], target=9),))], [t]),
            "names the node 9",
        ),
        (
            lambda t: ([replace(t, nodes=(replace(t.nodes[0], name=None), *t.nodes[1:]))], [t]),
            "does not name a point cloud",
        ),
    ],
)
def test_where_the_official_evaluator_fails_ours_says_why(scene, change, words):
    target, clouds = scene
    truth, prediction = change(target)
    with pytest.raises(InputError, match=words):
        score_challenge(truth, prediction, clouds)


def test_missing_and_unusable_point_clouds(scene, tmp_path):
    target, _ = scene
    with pytest.raises(InputError, match="no folder of point clouds"):
        clouds_in(tmp_path / "nowhere")
    (tmp_path / "Bldg0_Stage1_Spot0.ply").unlink()
    with pytest.raises(FormatError, match=r"Spot0\.ply is missing"):
        score_challenge([target], [target], clouds_in(tmp_path))
    bad = np.full((5, 3), np.nan)
    path = tmp_path / "Bldg0_Stage1_Spot0.ply"
    write_ply(path, {axis: bad[:, k] for k, axis in enumerate("xyz")})
    with pytest.raises(FormatError, match="non-finite"):
        score_challenge([target], [target], clouds_in(tmp_path))
    write_ply(path, {axis: bad[:0, k] for k, axis in enumerate("xyz")})
    with pytest.raises(FormatError, match="no points"):
        score_challenge([target], [target], clouds_in(tmp_path))
