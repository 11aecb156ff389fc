"""`nss propose` on a part of the bundled bag."""

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from nss_ros.bag import read_log, write_bag
from nss_ros.cli.propose import propose
from nss_ros.errors import BagError, InputError
from nss_ros.fragment import Fragment, FragmentPair

app = typer.Typer()
app.command()(propose)
BAG = Path(__file__).parents[2] / "bags" / "three_stages"


@pytest.fixture(scope="module")
def log():
    return read_log(BAG)


@pytest.fixture(scope="module")
def some(log):
    return [each for each in log.fragments.values() if each.id.stage < 3 and each.id.spot <= 3]


def go(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments), "--workers", "1"])


def test_pairs_are_added_to_those_that_are_asked_for(tmp_path, log, some):
    asked = FragmentPair(some[1].id, some[0].id)
    write_bag(tmp_path / "bag", some, [asked], log.ground_truth, {"made": "here"})
    result = go(tmp_path / "bag", "-o", tmp_path / "new", "--within", 1, "--across", 1, "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    new = read_log(tmp_path / "new")
    assert asked in new.pairs
    assert len(new.pairs) == summary["pairs"] <= 1 + 2 * len(some)
    assert len({frozenset((p.source, p.target)) for p in new.pairs}) == len(new.pairs)
    assert (summary["given"], summary["unfit"]) == (1, [])
    assert summary["possible"] == len(some) * (len(some) - 1) // 2
    assert list(new.fragments) == [each.id for each in some]
    assert len(new.ground_truth) == len(log.ground_truth)
    assert new.metadata["made"] == "here"


def test_anew_forgets_what_was_asked_for(tmp_path, some):
    every = [FragmentPair(a.id, b.id) for a in some for b in some if a.id < b.id]
    write_bag(tmp_path / "bag", some, every)
    out = tmp_path / "new"
    result = go(tmp_path / "bag", "-o", out, "--within", 1, "--across", 0, "--anew")
    assert result.exit_code == 0, result.output
    pairs = read_log(out).pairs
    assert 0 < len(pairs) < len(every)
    assert all(pair.same_stage for pair in pairs)
    assert f"{len(pairs)} of {len(every)} possible pairs" in " ".join(result.stdout.split())


def test_fragments_that_are_not_levelled_are_told(tmp_path, some):
    loose = Fragment(some[0].id, some[0].points, False)
    write_bag(tmp_path / "bag", [loose, *some[1:]], [])
    result = go(tmp_path / "bag", "-o", tmp_path / "new")
    assert result.exit_code == 0, result.output
    assert f"{loose.id} for example" in " ".join(result.stdout.split())
    new = read_log(tmp_path / "new")
    assert not any(loose.id in (pair.source, pair.target) for pair in new.pairs)


def test_a_bag_without_levelled_fragments_is_refused(tmp_path, some):
    write_bag(tmp_path / "bag", [Fragment(each.id, each.points, False) for each in some], [])
    result = go(tmp_path / "bag", "-o", tmp_path / "new")
    assert isinstance(result.exception, InputError)
    assert "levelled" in str(result.exception)
    assert not (tmp_path / "new").exists()


def test_a_bag_that_is_not_there_and_one_that_is_in_the_way(tmp_path, some):
    assert isinstance(go(tmp_path / "none", "-o", tmp_path / "new").exception, BagError)
    write_bag(tmp_path / "bag", some, [])
    assert isinstance(go(tmp_path / "bag", "-o", tmp_path / "bag").exception, BagError)
    assert len(read_log(tmp_path / "bag").fragments) == len(some)
