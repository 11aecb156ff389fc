import json
from dataclasses import replace

import pytest
import typer
from typer.testing import CliRunner

from nss_ros.bag import write_bag
from nss_ros.cli.compare import compare_logs
from nss_ros.errors import InputError

app = typer.Typer()
app.command()(compare_logs)


def run(*arguments, status=0):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture
def logs(room, tmp_path, record):
    """A good run and a bad one, over the same bag."""
    fragments = [replace(f, points=f.points[::40]) for f in room.fragments]
    write_bag(tmp_path / "bag", fragments, room.pairs, [room.ground_truth])
    good = record(tmp_path / "bag").rename(tmp_path / "good")
    return good, record(tmp_path / "bag", noise=0.15, unanswered=2).rename(tmp_path / "bad")


def test_tables(logs):
    text = run(*logs).stdout
    for words in ("bad against good", "pairwise recall, different", "worse", "Pairs won and lost"):
        assert words in text
    assert "bad is partial: 2 of 15 pairs have no answer" in " ".join(text.split())
    text = run(*logs, "--format", "markdown", "--table", "intervals").stdout
    assert "**bad against good: bootstrap intervals**" in text


def test_json_lists_the_pairs(logs, room):
    good, bad = logs
    (result,) = json.loads(run(good, bad, "--json").stdout)["comparisons"]
    assert result["edges"] == 15
    assert result["pairwise"]["won"] == []
    last = room.pairs[-1]
    assert [str(last.source), str(last.target)] in result["pairwise"]["lost"]
    recall = result["differences"]["recall_all"]
    assert recall["difference"] == pytest.approx(-100 / 15 * len(result["pairwise"]["lost"]))
    assert recall["better"] is False
    both = json.loads(run(good, bad, good, "--json").stdout)["comparisons"]
    assert [each["log"] for each in both] == [str(bad), str(good)]
    assert both[1]["multiway"] == {"won": [], "lost": []}


def test_gates_judge_the_logs_and_their_differences(logs):
    good, bad = logs
    for gate in ("recall_different_stage < 0.9", "delta_recall_all < -5 %", "delta_rte_all > 0.01"):
        result = run(good, bad, "--fail-if", gate, status=3)
        assert gate in result.stderr.replace("\n", "")
        run(bad, good, "--fail-if", gate)
        run(good, good, "--fail-if", gate)


def test_what_cannot_be_compared(logs, tmp_path, room):
    fragments = [replace(f, points=f.points[::40]) for f in room.fragments]
    with pytest.raises(InputError, match="holds no answers"):
        compare_logs(logs[0], [tmp_path / "bag"])
    with pytest.raises(InputError, match=r"'recall < 1' names no figure .* delta_recall_all"):
        compare_logs(logs[0], [logs[1]], fail_if=["recall < 1"])
    write_bag(tmp_path / "hidden", fragments, room.pairs)
    with pytest.raises(InputError, match="holds no ground truth"):
        compare_logs(logs[0], [tmp_path / "hidden"])
