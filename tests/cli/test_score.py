import csv
import io
import json
import shutil
from dataclasses import replace

import pytest
import typer
from typer.testing import CliRunner

from nss_ros.bag import write_bag
from nss_ros.cli.import_ import import_folder
from nss_ros.cli.score import score
from nss_ros.errors import InputError

app = typer.Typer()
app.command()(score)


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture
def room_bag(room, tmp_path):
    fragments = [replace(f, points=f.points[::20]) for f in room.fragments]
    write_bag(tmp_path / "bag", fragments, room.pairs, [room.ground_truth])
    return tmp_path / "bag"


def test_a_log_as_json(room_bag, record):
    result = json.loads(run(record(room_bag), "--json"))
    assert result["partial"] is False
    assert result["overall"]["pairwise"]["all"]["recall"] == 100.0
    assert result["overall"]["multiway"]["different_stage"]["edges"] == 9
    assert result["overall"]["map"]["placed"] == 6
    assert 0 < result["overall"]["map"]["global_rmse"] < 0.2


def test_a_log_as_tables(room_bag, record):
    text = run(record(room_bag))
    assert "PARTIAL" not in text
    for words in ("Pairwise", "Multi-way", "different", "global"):
        assert words in text


def test_the_figures_of_a_log_as_files(room_bag, record, tmp_path):
    figures = tmp_path / "figures"
    text = run(record(room_bag), "--figures", figures, "--ending", "svg", "--worst", "0")
    assert "Pairwise" in text
    assert {"error_distributions.svg", "map_1.svg"} <= {path.name for path in figures.iterdir()}


def test_unanswered_pairs_and_a_truncated_file_are_told(room_bag, record):
    log = record(room_bag, unanswered=4)
    assert "PARTIAL: 4 of 15 pairs have no answer" in run(log)
    (file,) = log.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-200])
    assert "PARTIAL: the log is truncated" in run(log)
    assert json.loads(run(log, "--json"))["truncated"] is True


def test_numbers_that_json_lacks_are_null(shared_data):
    folder = shared_data / "nss_challenge"
    files = ("--target", folder / "mock_target_2025.json",
             "--prediction", folder / "mock_prediction_2025.json")  # fmt: skip
    result = json.loads(run(*files, "--json"))
    assert result["overall"]["All"]["Average Translation Error"] is None
    assert "Global RMSE" not in result["overall"]["All"]


def test_challenge_files(shared_data):
    folder = shared_data / "nss_challenge"
    files = ("--target", folder / "mock_target_2025.json",
             "--prediction", folder / "prediction_with_edges_2025.json",
             "--points", folder / "pointclouds", "--translation-threshold", 0.2)  # fmt: skip
    expected = json.loads((folder / "expected.json").read_text())
    figures = expected["mock_target_2025|prediction_with_edges_2025|0.2"]["Bldg0_Scene1"]
    result = json.loads(run(*files, "--json"))
    for subset, values in result["scenes"]["Bldg0_Scene1"].items():
        assert values == pytest.approx(figures[subset], abs=1e-6)
    assert result["overall"] == result["scenes"]["Bldg0_Scene1"]
    text = run(*files)
    assert "Registration Recall [%]" in text
    assert "88.889" in text


def test_the_red_kitchen_scores_as_a_log(shared_data, tmp_path, record):
    import_folder(shared_data / "redkitchen", tmp_path / "bag")
    result = json.loads(run(record(tmp_path / "bag"), "--json"))
    overall = result["overall"]
    assert overall["multiway"]["all"]["recall"] == 100.0
    assert overall["multiway"]["different_stage"]["edges"] == 0
    assert overall["multiway"]["different_stage"]["recall"] is None
    assert overall["map"]["coverage"] == 100.0
    assert overall["map"]["global_rmse"] == pytest.approx(overall["map"]["official_global_rmse"])


def test_arguments_that_do_not_fit(room_bag, tmp_path):
    for arguments in ({}, {"target": tmp_path}, {"logs": [tmp_path], "target": tmp_path}):
        with pytest.raises(InputError, match="either a LOG, or both --target and --prediction"):
            score(**arguments)
    with pytest.raises(InputError, match="--points belongs to"):
        score([tmp_path], points=tmp_path)
    with pytest.raises(InputError, match="bag holds no answers"):
        score([room_bag])


def test_several_logs_stand_side_by_side(room_bag, record, tmp_path):
    first = record(room_bag)
    second = first.rename(tmp_path / "first")
    logs = second, record(room_bag, noise=0.3)
    text = run(*logs, "--table", "pairwise")
    assert "first" in text
    assert "best of five *" in text
    result = json.loads(run(*logs, "--json", "--resamplings", 0))
    assert [each["overall"]["pairwise"]["all"]["edges"] for each in result["logs"]] == [15, 15]
    together = json.loads(run(*logs, "--together", "--json"))
    assert together["overall"]["pairwise"]["all"]["edges"] == 30


def test_formats(room_bag, record):
    log = record(room_bag)
    rows = list(csv.DictReader(io.StringIO(run(log, "--format", "csv", "--table", "map"))))
    assert [(row["graph"], row["in main component"]) for row in rows] == [("room", "6")]
    assert run(log, "--format", "csv", "--table", "map", "--table", "multiway").startswith(
        "# Map\n"
    )
    assert run(log, "--format", "markdown").startswith("**Pairwise: relative transforms**\n")
    assert run(log, "--format", "latex", "--table", "intervals").count("tabular") == 2
    with pytest.raises(InputError, match="no table 'maps' here; there are pairwise, multiway, map"):
        score([log], table=["maps"])


def test_intervals_are_seeded(room_bag, record):
    log = record(room_bag, noise=0.05)
    first, second, other = (
        json.loads(run(log, "--json", "--seed", seed))["headline"] for seed in (0, 0, 1)
    )
    assert first == second != other
    assert first["rte_all"]["low"] < first["rte_all"]["value"] < first["rte_all"]["high"]


@pytest.mark.parametrize("gate", ["recall_different_stage < 0.9", "unanswered > 3"])
def test_gates(room_bag, record, gate):
    good, arguments = record(room_bag), ("--fail-if", gate, "--resamplings", "0")
    run(good, *arguments)
    shutil.rmtree(good)
    bad = record(room_bag, noise=1.0, unanswered=4)
    result = CliRunner().invoke(app, [str(bad), *arguments])
    assert result.exit_code == 3
    assert f"{bad}: {gate} (" in result.stderr.replace("\n", "")
    assert "Pairwise" in result.stdout


def test_gates_that_cannot_be_judged(room_bag, record):
    with pytest.raises(InputError, match=r"names no figure .* recall_all"):
        score([room_bag], fail_if=["recal < 0.9"])
    with pytest.raises(InputError, match="has no overlap_auroc"):
        score([record(room_bag)], fail_if=["overlap_auroc < 0.9"])
    with pytest.raises(InputError, match="--fail-if, --together and --figures belong to logs"):
        score(None, room_bag, room_bag, fail_if=["recall_all < 0.9"])


@pytest.mark.parametrize("width", [40, 80, 120, 200])
def test_no_number_is_cut_however_narrow_the_terminal(room_bag, record, width):
    log = record(room_bag)
    whole = run(log, "--format", "csv", "--table", "pairwise")
    result = CliRunner().invoke(app, [str(log), "--table", "pairwise"], env={"COLUMNS": str(width)})
    assert max(len(line) for line in result.stdout.splitlines()) <= width
    for row in csv.DictReader(io.StringIO(whole)):
        for heading, form in (("RTE (m)", ".3f"), ("RRE of all (deg)", ".2f"), ("RMSE (m)", ".3f")):
            assert format(float(row[heading]), form) in result.stdout.split()
