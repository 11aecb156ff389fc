"""From a site to a dataset with pairs, graphs, tables and a bag, by the commands."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from nss_ros.bag import read_log
from nss_ros.cli.main import app
from nss_ros.dataset.challenge_folder import read_folder, read_fragment
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.ply import write_ply
from nss_ros.dataset.refinement import read_refined
from nss_ros.errors import BagError, ConfigError, FormatError, InputError
from nss_ros.geometry import from_yaw, inverse, relative, transform_points
from nss_ros.registration.gravity.scan import is_wide_scan

SMALL = ["--seed", "3", "--spots-per-stage", "4", "--workers", "1"]
SMALL += ["-s", "simulation.rig.image_width=60", "-s", "simulation.rig.image_height=45"]
SITE = """
areas:
  "1": {procedural: {width: 14, depth: 11, stages: 2}}
  "2": {procedural: {width: 14, depth: 11, stages: 2, use: residential}}
"""


def run(*arguments):
    return CliRunner().invoke(app, [str(each) for each in arguments])


def run_json(*arguments):
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of two areas and the bag that was written with it."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "site.yaml").write_text(SITE)
    summary = run_json(
        "simulate", folder / "site.yaml", "-o", folder / "dataset", "--bag", folder / "bag", *SMALL
    )
    return folder, summary


def test_a_dataset_without_graphs_becomes_the_same_bag(made, tmp_path):
    folder, summary = made
    shutil.copytree(folder / "dataset", tmp_path / "dataset")
    shutil.rmtree(tmp_path / "dataset" / "pose_graph", ignore_errors=True)
    imported = run_json("import", tmp_path / "dataset", "-o", tmp_path / "bag")
    assert imported["fragments"] == summary["fragments"]
    one, other = read_log(folder / "bag"), read_log(tmp_path / "bag")
    assert (one.pairs, list(one.fragments)) == (other.pairs, list(other.fragments))
    assert [graph.poses().keys() for graph in one.ground_truth] == [
        graph.poses().keys() for graph in other.ground_truth
    ]
    result = run("import", tmp_path / "dataset", "-o", tmp_path / "none", "--pairs", "all")
    assert isinstance(result.exception, InputError)
    assert "nss graphs" in str(result.exception)
    (tmp_path / "dataset" / "pairs.csv").unlink()
    result = run("import", tmp_path / "dataset", "-o", tmp_path / "none")
    assert isinstance(result.exception, InputError)
    assert "nss pairs" in str(result.exception)


def test_a_laser_scanner_sees_far_in_all_directions(tmp_path):
    config = Path(__file__).parents[2] / "config" / "laser_scanner.yaml"
    (tmp_path / "site.yaml").write_text(
        "areas: {'1': {procedural: {width: 30, depth: 14, stages: 2}}}"
    )
    options = ["--config", config, "--spots-per-stage", 1, "--seed", 3, "--workers", 1]
    options += ["-s", "simulation.rig.image_width=80", "-s", "simulation.rig.image_height=120"]
    run_json("simulate", tmp_path / "site.yaml", "-o", tmp_path / "dataset", *options)
    dataset = DatasetFolder(tmp_path / "dataset")
    for id_ in dataset.fragment_ids():
        fragment = dataset.fragment(id_)
        assert is_wide_scan(fragment)
        azimuth = np.arctan2(fragment.points[:, 1], fragment.points[:, 0])
        assert np.histogram(azimuth, 12, (-np.pi, np.pi))[0].min() > 100
        beside = np.hypot(fragment.points[:, 0], fragment.points[:, 1]) < 1
        assert fragment.points[beside, 2].min() < -1.4  # the floor at its feet


def test_the_dataset_and_the_bag_hold_what_the_summary_says(made):
    folder, summary = made
    dataset = DatasetFolder(folder / "dataset")
    assert dataset.manifest.complete
    ids = dataset.fragment_ids()
    assert [str(id_) for id_ in ids[:4]] == [f"Bldg1_Stage1_Spot{spot}" for spot in (1, 2, 3, 4)]
    assert summary["fragments"] == len(ids) == 16
    log = read_log(folder / "bag")
    assert list(log.fragments) == ids
    for id_ in ids:
        assert np.array_equal(log.fragments[id_].points, dataset.fragment(id_).points)
        assert log.fragments[id_].gravity_aligned
    poses = dataset.poses()
    assert [graph.name for graph in log.ground_truth] == ["Bldg1_Graph1", "Bldg2_Graph1"]
    for graph in log.ground_truth:
        for node in graph.nodes:
            np.testing.assert_allclose(node.T_map_fragment, poses[node.id], atol=1e-9)
        assert all(edge.overlap_ratio >= 0.1 for edge in graph.edges)
    edges = {edge.pair for graph in log.ground_truth for edge in graph.edges}
    assert edges == set(log.pairs)
    same = sum(pair.same_stage for pair in log.pairs)
    assert summary["bag"]["same_stage_pairs"] == same
    assert summary["bag"]["different_stage_pairs"] == len(log.pairs) - same
    assert log.metadata["simulation.seed"] == "3"
    assert log.metadata["sites.areas.2.procedural.use"] == "residential"


def test_same_seed_same_bytes(made, tmp_path):
    folder, _ = made
    run_json("simulate", folder / "site.yaml", "-o", tmp_path / "again", *SMALL, "--workers", 2)
    for path in sorted((tmp_path / "again").rglob("*")):
        if path.is_file() and path.name != "manifest.json":
            other = folder / "dataset" / path.relative_to(tmp_path / "again")
            assert path.read_bytes() == other.read_bytes(), path.name


def test_a_run_that_was_cut_short_is_completed(made, tmp_path):
    folder, _ = made
    run_json("simulate", folder / "site.yaml", "-o", tmp_path / "cut", *SMALL)
    whole = (tmp_path / "cut" / "poses.jsonl").read_text()
    lost = tmp_path / "cut" / "point_cloud" / "Bldg2_Stage2_Spot4.ply"
    before = lost.read_bytes()
    lost.unlink()
    (tmp_path / "cut" / "poses.jsonl").write_text(whole[: whole.rindex("{") + 30])
    run_json("simulate", folder / "site.yaml", "-o", tmp_path / "cut", *SMALL)
    assert lost.read_bytes() == before
    assert (tmp_path / "cut" / "poses.jsonl").read_text() == whole
    result = run("simulate", folder / "site.yaml", "-o", tmp_path / "cut", "--seed", 4)
    assert isinstance(result.exception, InputError)
    assert "seed = 3, not 4" in str(result.exception)


def test_a_site_file_may_say_where_tripods_are_put(tmp_path):
    site = tmp_path / "site.yaml"
    site.write_text(
        "{areas: {a: {procedural: {width: 14, depth: 11, stages: 1}}},"
        " viewpoints: {spots_per_stage: 1}}"
    )
    others = [option for option in SMALL if option not in ("--spots-per-stage", "4")]
    assert run_json("simulate", site, "-o", tmp_path / "one", *others)["fragments"] == 1
    assert run_json("simulate", site, "-o", tmp_path / "four", *SMALL)["fragments"] == 4
    viewpoints = DatasetFolder(tmp_path / "one").manifest.simulation["viewpoints"]
    assert viewpoints["spots_per_stage"] == 1


def test_pairs_are_split_and_graphs_make_a_challenge_folder(made):
    folder, _ = made
    dataset = folder / "dataset"
    summary = run_json("pairs", dataset, "--workers", 1, "--select", 6)
    assert set(summary["splits"]) == {"original", "cross_area", "cross_stage"}
    assert 0 < summary["selected"]["same_stage"] <= 6
    cross_area = summary["splits"]["cross_area"]
    assert all(cross_area["test"][kind] > 0 for kind in ("same_stage", "different_stage"))
    assert (dataset / "splits" / "cross_area" / "test.csv").is_file()
    graphs = run_json("graphs", dataset, "-s", "dataset.graphs.sizes=[5]", "--count", 2)
    assert graphs["sets"]["all"]["graphs"] > 0
    challenge = read_folder(dataset)
    assert len(challenge.graphs) == graphs["sets"]["all"]["graphs"]
    for id_, file in challenge.point_files.items():
        fragment, dropped = read_fragment(id_, file, gravity_aligned=True)
        assert dropped == 0
        assert np.array_equal(fragment.points, DatasetFolder(dataset).fragment(id_).points)
    imported = run_json("import", dataset, "-o", dataset.with_name("imported"))
    log = read_log(dataset.with_name("imported"))
    assert len(log.pairs) == imported["pairs"] > 0
    assert all(fragment.gravity_aligned for fragment in log.fragments.values())
    whole = run_json(
        "graphs", dataset, "--kind", "multiway", "--split", "cross_area",
        "-s", "dataset.graphs.min_component=3",
    )  # fmt: skip
    assert set(whole["sets"]) == {"train", "val", "test"}
    assert DatasetFolder(dataset).manifest.steps["pairs"]["seed"] == 0


def test_a_release_goes_out_and_comes_back(made, tmp_path):
    folder, _ = made
    dataset = DatasetFolder(folder / "dataset")
    if not (folder / "dataset" / "pairs.csv").exists():
        run_json("pairs", folder / "dataset", "--workers", 1)
    written = run_json("export", folder / "dataset", "--layout", "release", "-o", tmp_path / "out")
    assert written["fragments"] == len(dataset.fragment_ids())
    brought = run_json("import", tmp_path / "out", "--as", "dataset", "-o", tmp_path / "back")
    assert brought["pairs"] == written["pairs"]
    back = DatasetFolder(tmp_path / "back")
    for id_, pose in dataset.poses().items():
        assert np.array_equal(back.poses()[id_], pose)
        assert np.array_equal(back.fragment(id_).points, dataset.fragment(id_).points)
    options = ("--split", "cross_area", "--subset", "test")
    bag = run_json("import", tmp_path / "out", "-o", tmp_path / "bag", *options)
    log = read_log(tmp_path / "bag")
    assert bag["pairs"] == len(log.pairs) == written["pairs"]["cross_area"]["test"]
    assert {id_.area for id_ in log.fragments} == {"2"}
    assert all(fragment.gravity_aligned for fragment in log.fragments.values())
    for arguments, message in [
        (("export", folder / "dataset", "-o", tmp_path / "out"), "exists already"),
        (("export", tmp_path, "--layout", "release", "-o", tmp_path / "x"), "not a dataset"),
        (("import", folder / "dataset", "--as", "dataset", "-o", tmp_path / "x"), "not a folder"),
        (("import", tmp_path / "out", "-o", tmp_path / "x", "--split", "mine"), "split 'mine'"),
    ]:
        result = run(*arguments)
        assert result.exit_code != 0
        assert message in str(result.exception)


def test_ground_truth_between_stages_is_refined(made, tmp_path):
    folder, _ = made
    dataset = folder / "dataset"
    summary = run_json("refine", dataset, "--workers", 1)
    refined = read_refined(dataset)
    assert len(refined) == summary["pairs"] > 0
    assert sum(each.accepted for each in refined.values()) == summary["refined"]
    poses = DatasetFolder(dataset).poses()
    for pair, each in refined.items():  # simulated poses are exact, so nothing moves far
        assert not pair.same_stage
        truth = relative(poses[pair.source], poses[pair.target])
        assert np.linalg.norm((inverse(truth) @ each.T_target_source)[:3, 3]) < 0.1
    plot = tmp_path / "radius.png"
    study = ("refine", dataset, "--study", plot, "--drift", 0.03, "--pairs", 2, "--workers", 1)
    rows = run_json(*study)["radii"]
    assert [row["radius"] for row in rows] == [2, 4, 6, 8, 10, 12, 14, 16, 18]
    assert all(row["error"] > 0 for row in rows)
    soon = run_json(*study, "--drift-length", 2)["radii"]
    assert [row["error"] for row in soon] != [row["error"] for row in rows]
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_stage_scans_of_a_user_are_aligned(tmp_path):
    rng = np.random.default_rng(0)
    walls = [(6.0, 0.0, 2.5), (0.0, 4.0, 2.5), (6.0, 4.0, 0.0)]  # three sides of a box
    points = np.concatenate([rng.uniform(0, 1, (4000, 3)) * size for size in walls])
    T_anchor_stage = from_yaw(0.4, (2.0, -1.0, 0.3))
    moved = transform_points(inverse(T_anchor_stage), points)
    for name, cloud in (("one.ply", moved), ("two.ply", points)):
        write_ply(tmp_path / name, dict(zip("xyz", cloud.astype(np.float32).T, strict=True)))
    corners = np.array([(0, 0, 0), (6, 0, 0), (0, 4, 0), (0, 0, 2.5)], dtype=float)
    picked = transform_points(inverse(T_anchor_stage), corners) + rng.normal(0, 0.02, (4, 3))
    lines = [
        ",".join(map(str, (1, *point, 2, *anchor)))
        for point, anchor in zip(picked.tolist(), corners.tolist(), strict=True)
    ]
    header = "stage,x,y,z,anchor_stage,anchor_x,anchor_y,anchor_z"
    (tmp_path / "picks.csv").write_text("\n".join([header, *lines]))
    arguments = ("align", tmp_path / "picks.csv", f"1={tmp_path / 'one.ply'}")
    output = tmp_path / "alignment.json"
    found = run_json(*arguments, f"2={tmp_path / 'two.ply'}", "-o", output)
    np.testing.assert_allclose(found["1"]["T_anchor_stage"], T_anchor_stage, atol=5e-3)
    np.testing.assert_array_equal(found["2"]["T_anchor_stage"], np.eye(4))
    assert json.loads(output.read_text()) == found
    result = run(*arguments, "-o", tmp_path / "none.json")
    assert isinstance(result.exception, InputError)
    assert "stage 2" in str(result.exception)
    result = run("align", tmp_path / "picks.csv", "shell.ply")
    assert "STAGE=PLY" in str(result.exception)


def test_tables_and_plots_are_made(made, tmp_path):
    folder, _ = made
    result = run("stats", folder / "dataset", "-o", tmp_path / "plots", "--format", "markdown")
    assert result.exit_code == 0, result.output
    assert "| 1 " in result.stdout
    names = {path.name for path in (tmp_path / "plots").iterdir()}
    assert {"pairs_all.png", "pairs_selected.png", "plan_1.png", "graph_2.png"} <= names
    tables = run_json("stats", folder / "dataset", "--table", "areas")
    (rows,) = tables.values()
    assert [row["area"] for row in rows if row["area"] != "total"] == ["1", "2"]


def test_pictures_of_a_site_are_drawn(made, tmp_path):
    folder, _ = made
    result = run("picture", folder / "site.yaml", "-o", tmp_path, "--width", 400)
    assert result.exit_code == 0, result.output
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"area_{a}_{v}.png" for a in (1, 2) for v in ("stages", "interiors")}


def test_what_is_wrong_is_one_sentence(made, tmp_path):
    folder, _ = made
    for arguments, kind, message in [
        (("simulate", "nowhere", "-o", tmp_path / "a"), InputError, "no site 'nowhere'"),
        (("simulate", "-o", tmp_path / "a", "--bag", folder / "bag"), BagError, "exists already"),
        (("simulate", "-o", folder), InputError, "not a dataset"),
        (("simulate", "-o", tmp_path / "a", "-s", "simulation.rig.tilt=-1"), ConfigError, "tilt"),
        (("pairs", tmp_path), FormatError, "not a dataset"),
        (("graphs", folder / "bag"), FormatError, "not a dataset"),
        (("stats", tmp_path / "none"), FormatError, "not a dataset"),
    ]:
        result = run(*arguments)
        assert isinstance(result.exception, kind), result.output
        assert message in str(result.exception)
    assert not (tmp_path / "a").exists()
