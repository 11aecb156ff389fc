import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from nss_ros.bag import read_log
from nss_ros.cli.import_ import import_folder
from nss_ros.dataset.challenge import read_graphs
from nss_ros.dataset.challenge_folder import METADATA_KEY
from nss_ros.dataset.ply import write_ply
from nss_ros.errors import FormatError
from nss_ros.geometry import as_transform

BAG = Path(__file__).parents[2] / "bags" / "three_stages"

app = typer.Typer()
app.command()(import_folder)


def assert_same_transform(stored, original):
    """A message holds a quaternion, so the rotation is the one nearest to the file's matrix.

    The scans' matrices are up to 2.6e-5 away from rotations; nothing else may be lost.
    """
    np.testing.assert_allclose(stored, as_transform(original), rtol=0, atol=1e-9)
    np.testing.assert_allclose(stored, original, rtol=0, atol=5e-5)


def test_red_kitchen(shared_data, tmp_path):
    folder = shared_data / "redkitchen"
    result = CliRunner().invoke(app, [str(folder), "-o", str(tmp_path / "bag"), "--json"])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert {key: summary[key] for key in ("graphs", "fragments", "pairs", "placed", "edges")} == {
        "graphs": 1,
        "fragments": 6,
        "pairs": 13,
        "placed": 6,
        "edges": 13,
    }
    assert not summary["gravity_aligned"]
    assert summary["points"] == 28767 + 29257 + 30192 + 28458 + 30481 + 29837

    log = read_log(tmp_path / "bag")
    (graph,) = read_graphs(folder / "pose_graph" / "val" / "Bldg7_Graph1.json")
    (truth,) = log.ground_truth
    assert truth.name == "Bldg7_Graph1"
    assert len(log.fragments) == 6
    assert set(log.pairs) == {edge.pair for edge in truth.edges}
    for node, original in zip(truth.nodes, graph.nodes, strict=True):
        assert f"{node.id}.ply" == original.name
        assert_same_transform(node.T_map_fragment, original.transform)
    for edge, original in zip(truth.edges, graph.edges, strict=True):
        assert_same_transform(edge.T_target_source, original.transform)
        assert edge.overlap_ratio == original.overlap_ratio


@pytest.mark.parametrize(
    ("options", "level"),
    [([], True), (["--not-gravity-aligned"], False), (["--gravity-aligned"], True)],
)
def test_scans_that_are_levelled_are_told_by_their_floors(tmp_path, options, level):
    log = read_log(BAG)
    (tmp_path / "scans" / "point_cloud").mkdir(parents=True)
    nodes = []
    for number, (id_, fragment) in enumerate(list(log.fragments.items())[:3]):
        columns = dict(zip("xyz", fragment.points.T, strict=True))
        write_ply(tmp_path / "scans" / "point_cloud" / f"{id_}.ply", columns)
        nodes.append({"id": number, "name": f"{id_}.ply"})
    graph = {"name": "Bldg1_Graph1", "nodes": nodes, "edges": []}
    (tmp_path / "scans" / "pose_graph").mkdir()
    (tmp_path / "scans" / "pose_graph" / "Bldg1_Graph1.json").write_text(json.dumps([graph]))
    arguments = [str(tmp_path / "scans"), "-o", str(tmp_path / "bag"), *options]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert ("look like scans of a levelled tripod" in result.output) == (not options)
    back = read_log(tmp_path / "bag")
    assert {fragment.gravity_aligned for fragment in back.fragments.values()} == {level}


def test_scans_in_which_another_axis_is_vertical_are_told(tmp_path):
    log = read_log(BAG)
    (tmp_path / "scans" / "point_cloud").mkdir(parents=True)
    nodes = []
    for number, (id_, fragment) in enumerate(list(log.fragments.items())[:2]):
        x, y, z = fragment.points.T
        columns = {"x": x, "y": z, "z": -y}
        write_ply(tmp_path / "scans" / "point_cloud" / f"{id_}.ply", columns)
        nodes.append({"id": number, "name": f"{id_}.ply"})
    graph = {"name": "Bldg1_Graph1", "nodes": nodes, "edges": []}
    (tmp_path / "scans" / "pose_graph").mkdir()
    (tmp_path / "scans" / "pose_graph" / "Bldg1_Graph1.json").write_text(json.dumps([graph]))
    result = CliRunner().invoke(app, [str(tmp_path / "scans"), "-o", str(tmp_path / "bag")])
    assert result.exit_code == 0, result.output
    assert "would if y were vertical" in result.output


def test_ground_truth_is_in_its_own_topic_only(shared_data, tmp_path):
    import_folder(shared_data / "redkitchen", tmp_path / "bag")
    log = read_log(tmp_path / "bag", points=False)
    assert not log.relative_transforms
    assert log.pose_graph is None
    assert "0.6446" not in json.dumps(log.metadata)
    (template,) = json.loads(log.metadata[METADATA_KEY])
    assert template["nodes"][0] == [0, "Bldg7_Stage1_Spot0.ply"]


@pytest.mark.parametrize("year", ["2024", "2025"])
def test_mock_data_of_both_years(shared_data, tmp_path, year):
    import_folder(shared_data / "nss_challenge", tmp_path / "bag", graph=f"mock_target_{year}")
    log = read_log(tmp_path / "bag", points=False)
    assert len(log.pairs) == 45
    assert [len(graph.nodes) for graph in log.ground_truth] == [10]


def test_a_bad_cloud_leaves_no_bag(shared_data, tmp_path):
    folder = tmp_path / "folder"
    shutil.copytree(shared_data / "redkitchen", folder, copy_function=shutil.copyfile)
    cloud = folder / "point_cloud" / "Bldg7_Stage1_Spot5.ply"
    cloud.write_bytes(cloud.read_bytes()[:5000])
    with pytest.raises(FormatError, match=r"Spot5\.ply is truncated"):
        import_folder(folder, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
