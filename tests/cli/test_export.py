import json
import os
import sys
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest

from nss_ros.bag import read_log, write_bag
from nss_ros.benchmark.challenge import score_challenge
from nss_ros.benchmark.clouds import clouds_in
from nss_ros.benchmark.score import score_log
from nss_ros.cli.export import export
from nss_ros.cli.import_ import import_folder
from nss_ros.dataset.challenge import read_graphs
from nss_ros.dataset.ply import read_ply
from nss_ros.errors import InputError
from nss_ros.geometry import from_quaternion, relative, transform_points


@pytest.fixture
def room_log(room, tmp_path, record):
    fragments = [replace(f, points=f.points[::20]) for f in room.fragments]
    write_bag(tmp_path / "bag", fragments, room.pairs, [room.ground_truth])
    return record(tmp_path / "bag")


def test_submission_of_imported_scans(shared_data, tmp_path, record):
    folder = shared_data / "redkitchen"
    import_folder(folder, tmp_path / "bag")
    log = record(tmp_path / "bag")
    export(log, tmp_path / "submission.json")
    target = read_graphs(folder / "pose_graph" / "val" / "Bldg7_Graph1.json")
    prediction = read_graphs(tmp_path / "submission.json")
    assert [(n.id, n.name) for n in prediction[0].nodes] == [
        (n.id, n.name) for n in target[0].nodes
    ]
    assert [(e.source, e.target) for e in prediction[0].edges] == [
        (e.source, e.target) for e in target[0].edges
    ]
    official = score_challenge(target, prediction, clouds_in(folder / "point_cloud")).overall["All"]
    ours = score_log(read_log(log)).overall
    # The file's matrices are scaled by up to 2.9e-5, which a quaternion cannot hold.
    assert official.recall == ours.multiway.all.recall_challenge
    assert official.pairwise_rmse == pytest.approx(ours.multiway.all.rmse, abs=2e-4)
    assert official.global_rmse == pytest.approx(ours.map.global_rmse, abs=2e-4)


@pytest.mark.skipif(
    not os.environ.get("NSS_OFFICIAL_EVALUATOR"), reason="needs the official evaluator"
)
def test_the_official_evaluator_takes_the_submission(shared_data, tmp_path, record):
    pytest.importorskip("sklearn.neighbors")
    sys.path.insert(0, os.environ["NSS_OFFICIAL_EVALUATOR"])
    from nss_challenge.evaluate_registration import evaluate

    folder = shared_data / "redkitchen"
    import_folder(folder, tmp_path / "bag")
    export(record(tmp_path / "bag"), tmp_path / "submission.json")
    target = tmp_path / "target.json"
    target.write_text(f"[{(folder / 'pose_graph' / 'val' / 'Bldg7_Graph1.json').read_text()}]")
    arguments = Namespace(
        target=str(target),
        prediction=str(tmp_path / "submission.json"),
        translation_threshold=0.1,
        rotation_threshold=10,
        point_cloud_dir=str(folder / "point_cloud"),
    )
    official = evaluate(arguments)["Bldg7_Graph1"]["All"]
    ours = score_challenge(
        read_graphs(target), read_graphs(tmp_path / "submission.json"),
        clouds_in(folder / "point_cloud"),
    ).overall["All"]  # fmt: skip
    assert ours.recall == official["Registration Recall"]
    assert ours.pairwise_rmse == pytest.approx(official["Pairwise RMSE"], abs=1e-9)
    assert ours.global_rmse == pytest.approx(official["Global RMSE"], abs=1e-9)


def test_tum_trajectory(room_log, tmp_path):
    export(room_log, tmp_path / "poses.tum")
    rows = np.loadtxt(tmp_path / "poses.tum")
    assert rows[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    for row, node in zip(rows, read_log(room_log).pose_graph.nodes, strict=True):
        pose = from_quaternion(row[4:], row[1:4])
        np.testing.assert_allclose(pose, node.T_map_fragment, atol=1e-9)


def test_g2o_graph(room_log, tmp_path):
    export(room_log, tmp_path / "graph.g2o")
    rows = [line.split() for line in (tmp_path / "graph.g2o").read_text().splitlines()]
    poses = {
        int(row[1]): from_quaternion([float(v) for v in row[5:9]], [float(v) for v in row[2:5]])
        for row in rows
        if row[0] == "VERTEX_SE3:QUAT"
    }
    edges = [row for row in rows if row[0] == "EDGE_SE3:QUAT"]
    assert (len(poses), len(edges)) == (6, 15)
    assert [row for row in rows if row[0] == "FIX"] == [["FIX", "0"]]
    for row in edges:
        measured = from_quaternion([float(v) for v in row[6:10]], [float(v) for v in row[3:6]])
        # g2o measures the second vertex in the frame of the first.
        np.testing.assert_allclose(
            measured, relative(poses[int(row[2])], poses[int(row[1])]), atol=0.3
        )
        information = np.zeros((6, 6))
        information[np.triu_indices(6)] = [float(value) for value in row[10:]]
        assert (np.linalg.eigvalsh(information.T, UPLO="L") > 0).all()
        # Turning about the source's own origin, and moving, cost what the covariance says.
        assert information[0, 0] > 0.9e4 / (1 + 0.5 * np.sum(measured[:3, 3] ** 2))


def test_merged_map(room_log, tmp_path):
    export(room_log, tmp_path / "map.ply")
    log = read_log(room_log)
    merged = read_ply(tmp_path / "map.ply")
    expected = [
        transform_points(node.T_map_fragment, log.fragments[node.id].points)
        for node in log.pose_graph.nodes
    ]
    np.testing.assert_allclose(merged, np.concatenate(expected), atol=1e-5)
    assert b"property int stage" in (tmp_path / "map.ply").read_bytes()[:300]


@pytest.mark.parametrize(("ending", "left_out"), [("tum", 2), ("ply", 2), ("g2o", 0)])
def test_components_without_a_place_in_the_frame_are_told(
    room, tmp_path, record, capsys, ending, left_out
):
    nodes = room.ground_truth.nodes
    apart = (*nodes[:4], *(replace(node, component=1) for node in nodes[4:]))
    truth = replace(room.ground_truth, nodes=apart)
    write_bag(tmp_path / "bag", room.fragments, room.pairs, [truth])
    log = record(tmp_path / "bag")
    export(log, tmp_path / f"out.{ending}")
    said = capsys.readouterr().out
    assert f"Wrote {6 - left_out} fragments" in said
    assert ("Left out 2 fragments of other components" in said) == (left_out > 0)
    export(log, tmp_path / f"out.{ending}", json=True)
    assert json.loads(capsys.readouterr().out)["left_out"] == left_out


def test_what_cannot_be_exported_says_so(room_log, tmp_path):
    with pytest.raises(InputError, match=r"must end in \.json, \.g2o, \.tum, \.ply"):
        export(room_log, tmp_path / "map.obj")
    for ending in ("json", "g2o", "tum", "ply"):
        with pytest.raises(InputError, match="nss map"):
            export(tmp_path / "bag", tmp_path / f"out.{ending}")
