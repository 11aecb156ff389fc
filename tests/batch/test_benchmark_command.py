"""`nss benchmark` as a stranger runs it."""

import json
import shutil

import pytest
from typer.testing import CliRunner

from nss_ros.cli.main import app
from nss_ros.errors import ConfigError, FormatError, InputError, MethodError, RunError

pytestmark = pytest.mark.usefixtures("plugins")


def run(*arguments):
    return CliRunner().invoke(app, [str(each) for each in arguments])


def benchmark(dataset, output, *arguments):
    return run("benchmark", dataset, "-m", "guess", "-o", output, "--workers", 1, *arguments)


def test_it_prints_the_tables_of_the_paper_and_score_prints_the_same(dataset_path, tmp_path):
    arguments = ["--split", "cross_area", "--split", "cross_stage"]
    arguments += ["--synchronizer", "choi", "--synchronizer", "tree"]
    result = benchmark(dataset_path, tmp_path / "results", *arguments)
    assert result.exit_code == 0, result.output
    for words in ("Pairwise registration", "Multi-way registration", "cross_stage", "tree", "Time"):
        assert words in result.stdout
    assert str(tmp_path / "results") in result.stderr.replace("\n", "")
    markdown = benchmark(
        dataset_path, tmp_path / "results", *arguments, "--format", "markdown"
    ).stdout  # fmt: skip
    logs = [tmp_path / "results" / "logs" / f"{split}-guess-choi"
            for split in ("cross_area", "cross_stage")]  # fmt: skip
    scored = run("score", *logs, "--format", "markdown", "--table", "pairwise").stdout
    table = markdown.split("**Pairwise registration**")[1].split("**")[0].strip()
    assert table in scored
    multiway = markdown.split("**Multi-way registration**")[1].split("**")[0]
    rows = [line.split("|")[1:4] for line in multiway.splitlines() if "guess" in line]
    ways = [row[2].strip() for row in rows]
    assert ways == ["-", "choi", "tree"] * 2
    assert {row[1].strip() for row in rows} == {"guess"}


def test_json_has_scores_and_seconds(dataset_path, tmp_path):
    output = tmp_path / "results"
    result = benchmark(dataset_path, output, "--pairwise-only", "--seed", 3, "--json")
    assert result.exit_code == 0, result.output
    content = json.loads(result.stdout)
    (log,) = content["logs"]
    assert log["path"] == str(output / "logs" / "all-guess-pairwise")
    assert log["score"]["overall"]["multiway"] is None
    (timing,) = content["timings"]
    assert timing["pairs"] == log["score"]["pairs"] == log["score"]["answered"]
    assert timing["fragments"] > 0
    assert timing["prepare"] > 0
    text = run("compare", log["path"], log["path"], "--json").stdout
    assert json.loads(text)["comparisons"][0]["pairwise"] == {"won": [], "lost": []}


def test_all_that_overlap(dataset_path, tmp_path):
    counts = [
        json.loads(
            benchmark(dataset_path, tmp_path / choice, "--pairs", choice, "--json").stdout
        )["logs"][0]["score"]["pairs"]
        for choice in ("selected", "overlapping")
    ]  # fmt: skip
    assert counts[0] < counts[1]


def error(result):
    assert result.exit_code != 0
    return result.exception


def test_bad_inputs_are_named(dataset_path, tmp_path):
    output = tmp_path / "results"
    assert "Invalid value for '--split'" in benchmark(
        dataset_path, output, "--split", "sideways"
    ).stderr.replace("\n", " ")  # fmt: skip
    found = error(benchmark(dataset_path, output, "-m", "magic"))
    assert isinstance(found, MethodError)
    assert "'magic'" in str(found)
    found = error(benchmark(dataset_path, output, "-s", "registration.fpfh.colour=1"))
    assert isinstance(found, ConfigError)
    found = error(benchmark(tmp_path, output))
    assert isinstance(found, FormatError)
    assert "is neither a dataset" in str(found)
    bare = tmp_path / "bare"
    shutil.copytree(dataset_path, bare)
    (bare / "pairs.csv").unlink()
    found = error(benchmark(bare, output))
    assert isinstance(found, InputError)
    assert f"run 'nss pairs {bare}' first" in str(found)
    (bare / "pairs.csv").write_text("source,target\n")
    found = error(benchmark(bare, output))
    assert isinstance(found, FormatError)
    assert "its header lacks 'overlap_ratio'" in str(found)
    lines = (dataset_path / "pairs.csv").read_text().splitlines()
    (bare / "pairs.csv").write_text(
        f"{lines[0]}\n" + lines[1].replace("_Spot1", "_Spot77", 1)[:-1] + "1\n"
    )
    found = error(benchmark(bare, output))
    assert isinstance(found, FormatError)
    assert "Spot77" in str(found)
    assert not output.exists()


def test_a_fragment_that_is_missing_is_named_and_what_is_there_stays(dataset_path, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(dataset_path, broken)
    victim = sorted((broken / "point_cloud").iterdir())[-1]
    victim.unlink()
    found = error(benchmark(broken, tmp_path / "results"))
    assert isinstance(found, FormatError)
    assert str(victim) in str(found)
    shutil.copy(dataset_path / "point_cloud" / victim.name, victim)
    assert benchmark(broken, tmp_path / "results").exit_code == 0


def test_a_synchronizer_that_fails_is_told_after_the_tables(dataset_path, tmp_path):
    arguments = ["--synchronizer", "broken", "--synchronizer", "choi"]
    result = benchmark(dataset_path, tmp_path / "results", *arguments)
    assert "Multi-way registration" in result.stdout
    found = error(result)
    assert isinstance(found, RunError)
    assert "no map today" in str(found)
