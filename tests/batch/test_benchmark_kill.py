"""A benchmark that is killed in the middle, and goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nss_ros.bag import read_log
from nss_ros.bag_reader import encode
from nss_ros.batch.journal import Journal
from nss_ros.messages import pose_graph_message, rosbags_family

_COMMAND = [sys.executable, "-c", "from nss_ros.cli import main; main()", "benchmark"]
_PATIENCE = 240.0


def start(dataset_path, output, *arguments, method="guess"):
    command = [*_COMMAND, dataset_path, "-m", method, "-o", output, "--json", *arguments]
    return subprocess.Popen(
        [str(each) for each in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finished(process):
    out, err = process.communicate(timeout=_PATIENCE)
    assert process.returncode == 0, err
    return json.loads(out)


def answered(output: Path) -> int:
    with Journal(output / "journal") as journal:
        return len(journal.of("guess"))


def children(process: int) -> set[int]:
    return {int(path.name) for path in Path("/proc").glob("[0-9]*") if _parent(path) == process}


def _parent(path: Path) -> int:
    try:
        return int((path / "stat").read_text().rsplit(")", 1)[1].split()[1])
    except (OSError, IndexError):
        return 0


def until(condition):
    end = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.usefixtures("plugins")
def test_a_killed_benchmark_goes_on_and_ends_like_one_that_was_not(
    dataset_path, tmp_path, monkeypatch
):
    workers = 2
    whole = finished(start(dataset_path, tmp_path / "whole", "--workers", workers))
    monkeypatch.setenv("GUESS_DELAY", "0.4")
    killed = tmp_path / "killed"
    process = start(dataset_path, killed, "--workers", workers)
    try:
        until(lambda: answered(killed) >= 3)
        orphans = children(process.pid)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert orphans
    before = answered(killed)
    assert 3 <= before < whole["timings"][0]["pairs"]
    assert not list(killed.glob("logs/*"))
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in orphans))
    prepared = tmp_path / "prepared"
    monkeypatch.setenv("GUESS_DELAY", "0")
    monkeypatch.setenv("GUESS_PREPARED", str(prepared))
    again = finished(start(dataset_path, killed, "--workers", workers))
    assert not prepared.exists()  # features were there
    for one, other in zip(whole["logs"], again["logs"], strict=True):
        assert content(one["path"]) == content(other["path"])
        assert Path(one["path"]).name == Path(other["path"]).name
        del one["score"]["log"], other["score"]["log"]
        assert one == other | {"path": one["path"]}
    assert not (killed / "work").exists()


def content(path: str):
    """All that a log tells but times."""
    log = read_log(Path(path))
    answers = [
        (pair, each.T_target_source.tobytes(), each.reason, each.confidence)
        for pair, each in ((pair, log.relative_transforms[pair]) for pair in log.pairs)
    ]
    graphs = [
        encode(pose_graph_message(graph, "map", 0, rosbags_family()))
        for graph in (*log.ground_truth, log.pose_graph)
    ]
    times = {"start_time", "benchmark.register_seconds", "benchmark.prepare_seconds"}
    metadata = {name: value for name, value in log.metadata.items() if name not in times}
    return log.partial, answers, graphs, metadata


def died(output: Path) -> int:
    with Journal(output / "journal") as journal:
        return sum(not entry.final for entry in journal.of("lethal").values())


@pytest.mark.usefixtures("plugins")
def test_pairs_whose_worker_died_are_tried_again_by_the_next_session(
    dataset_path, tmp_path, monkeypatch
):
    """Workers that kill themselves, then are tamed; the session that mends it is killed, too."""
    arguments = ("--split", "cross_stage", "--split", "all", "--workers", 1)
    output = tmp_path / "results"
    first = finished(start(dataset_path, output, *arguments, method="lethal"))
    lost = died(output)
    assert lost > 1
    assert all(log["score"]["failed"] > 0 for log in first["logs"])
    # What dies again changes nothing.
    files = {path: path.stat().st_mtime_ns for path in output.glob("logs/*/*.mcap")}
    again = finished(start(dataset_path, output, *arguments, method="lethal"))
    assert (died(output), again["logs"]) == (lost, first["logs"])
    assert {path: path.stat().st_mtime_ns for path in output.glob("logs/*/*.mcap")} == files

    monkeypatch.setenv("GUESS_TAMED", "1")
    whole = finished(start(dataset_path, tmp_path / "whole", *arguments, method="lethal"))
    monkeypatch.setenv("GUESS_DELAY", "0.4")
    process = start(dataset_path, output, *arguments, method="lethal")
    try:
        until(lambda: died(output) < lost)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert died(output) > 0
    monkeypatch.setenv("GUESS_DELAY", "0")
    # One split by itself: the log of the other is out of date, and made anew when asked for.
    finished(start(dataset_path, output, *arguments[2:], method="lethal"))
    assert died(output) == 0
    mended = finished(start(dataset_path, output, *arguments, method="lethal"))
    for one, other in zip(whole["logs"], mended["logs"], strict=True):
        assert content(one["path"]) == content(other["path"])
        assert other["score"]["failed"] == 0


@pytest.mark.usefixtures("plugins")
def test_ctrl_c_ends_at_once_and_keeps_what_is_there(dataset_path, tmp_path, monkeypatch):
    monkeypatch.setenv("GUESS_DELAY", "0.4")
    process = start(dataset_path, tmp_path / "results", "--workers", 2)
    try:
        until(lambda: answered(tmp_path / "results") >= 2)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=_PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert answered(tmp_path / "results") >= 2
    assert os.path.exists(tmp_path / "results" / "benchmark.json")  # noqa: PTH110
