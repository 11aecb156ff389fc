import json
import re
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from nss_ros.bag import read_log, write_bag
from nss_ros.bag_reader import BagReader
from nss_ros.benchmark.run_timing import timing_of
from nss_ros.cli.report import report
from nss_ros.errors import BagError, InputError

app = typer.Typer()
app.command()(report)
FAST = ("--resamplings", 10, "--worst", 1)


def run(*arguments, fails_with=None):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if fails_with is not None:
        assert isinstance(result.exception, fails_with)
        return str(result.exception)
    assert result.exit_code == 0, result.output
    return result.stderr


@pytest.fixture
def room_bag(room, tmp_path):
    fragments = [replace(f, points=f.points[::40]) for f in room.fragments]
    write_bag(tmp_path / "bag", fragments, room.pairs, [room.ground_truth])
    return tmp_path / "bag"


def test_a_report_and_its_figures(room_bag, record, tmp_path):
    log = record(room_bag)
    output, figures = tmp_path / "r.html", tmp_path / "figures"
    told = run(log, "-o", output, "--figures", figures, "--ending", "svg", *FAST)
    text = output.read_text()
    assert text.startswith("<!doctype html>")
    assert "Recall of the map" in text
    names = {path.name for path in figures.iterdir()}
    assert {"error_distributions.svg", "graph_1.svg", "map_1.svg", "timing.svg"} <= names
    assert re.search(r"Wrote \S+r\.html", told)
    data = re.search(r'id="report-data">(.*?)</script>', text)[1]
    assert json.loads(data)["maps"]


def test_a_log_is_read_once(room_bag, record, tmp_path, monkeypatch):
    log = record(room_bag)
    read = []
    messages = BagReader.messages

    def counted(self, types=None):
        read.append(self.path)
        return messages(self, types)

    monkeypatch.setattr(BagReader, "messages", counted)
    run(log, "-o", tmp_path / "r.html", *FAST)
    assert read == [log]


def test_a_bag_that_was_never_mapped_gives_a_report_that_says_so(room_bag, tmp_path):
    output = tmp_path / "r.html"
    run(room_bag, "-o", output, *FAST)
    text = output.read_text()
    assert "The log holds no answers to pairs." in text
    assert "The log holds no map." in text


def test_what_cannot_be_written_or_read_says_so_and_keeps_what_was_there(
    room_bag, record, tmp_path
):
    log = record(room_bag)
    output = tmp_path / "r.html"
    output.write_text("old")
    assert "no bag at" in run(tmp_path / "none", "-o", output, fails_with=BagError)
    assert "is a folder" in run(log, "-o", tmp_path, fails_with=InputError)
    assert "no folder" in run(log, "-o", tmp_path / "a" / "r.html", fails_with=InputError)
    message = run(log, "-o", output, "--ending", "gif", fails_with=InputError)
    assert "png, svg, pdf" in message
    assert output.read_text() == "old"


def test_times_of_a_log(room_bag, record):
    times = timing_of(read_log(record(room_bag, unanswered=2)))
    assert len(times.fragments) == 6
    assert len(times.requests) == 15
    assert len(times.pairs) == len(times.answers) == 13
    assert (np.diff(times.answers) >= 0).all()
    assert (times.latency >= 0).all()
    assert times.fragments[0] == 0
