"""Whole runs: bags in, log out, over DDS."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import read_log, write_bag
from nss_ros.config import load_config
from nss_ros.errors import BagError, NodeError, NssError, RunError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import inverse, rotation_angle
from nss_ros.multiway.pose_graph import NodeStatus
from nss_ros.nodes.mapping import run_mapping
from nss_ros.registration.relative_transform import Reason

pytestmark = pytest.mark.ros

SETTINGS = ["player.rate=0", "pose_graph.update_period=0.5"]


@pytest.fixture(scope="module")
def log(tmp_path_factory, room_bag, domain_of_module):  # noqa: ARG001 - it is run there
    """The log of one undisturbed run, for all to compare with."""
    output = tmp_path_factory.mktemp("runs") / "log"
    run_mapping([room_bag], output, load_config(None, SETTINGS), timeout=400)
    return read_log(output)


def assert_same_result(one, other) -> None:
    assert set(one.relative_transforms) == set(other.relative_transforms)
    for pair, result in one.relative_transforms.items():
        again = other.relative_transforms[pair]
        assert result.reason == again.reason
        np.testing.assert_array_equal(result.T_target_source, again.T_target_source)
    for node, again in zip(one.pose_graph.nodes, other.pose_graph.nodes, strict=True):
        assert (node.id, node.status, node.component) == (again.id, again.status, again.component)
        np.testing.assert_array_equal(node.T_map_fragment, again.T_map_fragment)


def test_a_run_maps_the_room(log, room):
    assert not log.partial
    assert set(log.relative_transforms) == set(room.pairs)
    poses = log.pose_graph.poses()
    assert {node.component for node in poses.values()} == {0}
    assert set(poses) == {node.id for node in room.ground_truth.nodes}
    for edge in room.ground_truth.edges:
        source = poses[edge.pair.source].T_map_fragment
        target = poses[edge.pair.target].T_map_fragment
        error = inverse(edge.T_target_source) @ inverse(target) @ source
        assert np.linalg.norm(error[:3, 3]) < 0.1
        assert np.rad2deg(rotation_angle(error)) < 3


def test_the_log_tells_how_it_was_made(log, room_bag):
    assert log.metadata["bag_0"] == str(room_bag)
    assert len(log.metadata["bag_0_sha256"]) == 64
    assert json.loads(log.metadata["config"])["registration"]["method"] == "gravity"
    assert log.metadata["git_revision"]
    assert log.ground_truth[0].name == "room"


def test_two_registration_nodes_and_another_order_give_the_same(tmp_path, log, room):
    bag = tmp_path / "reversed"
    write_bag(bag, room.fragments[::-1], room.pairs[::-1], [room.ground_truth])
    config = load_config(None, SETTINGS)
    run_mapping([bag], tmp_path / "log", config, registration_nodes=2, timeout=400)
    assert_same_result(log, read_log(tmp_path / "log"))


def test_one_bag_per_stage_in_a_row_gives_one_map(tmp_path, room):
    bags = []
    for stage in (1, 2):
        fragments = [f for f in room.fragments if f.id.stage == stage]
        pairs = [p for p in room.pairs if p.source.stage == p.target.stage == stage]
        bags.append(tmp_path / f"stage_{stage}")
        write_bag(bags[-1], fragments, pairs)
    config = load_config(None, SETTINGS)
    progress = run_mapping(bags, tmp_path / "log", config, namespace="/site/a", timeout=400)
    assert progress.pairs_total == len(room.pairs)
    result = read_log(tmp_path / "log")
    assert set(result.relative_transforms) == set(room.pairs)
    assert len(result.pose_graph.poses()) == len(room.fragments)


def test_a_bag_without_pairs_is_mapped_by_proposed_ones(tmp_path, room):
    bags = []
    for stage in (1, 2):
        bags.append(tmp_path / f"stage_{stage}")
        write_bag(bags[-1], [f for f in room.fragments if f.id.stage == stage], [])
    config = load_config(None, SETTINGS)
    progress = run_mapping(bags, tmp_path / "log", config, registration_nodes=2, timeout=400)
    result = read_log(tmp_path / "log")
    assert progress.pairs_total == len(result.pairs) == len(result.relative_transforms) > 0
    assert {pair.same_stage for pair in result.pairs} == {True, False}
    poses = result.pose_graph.poses()
    assert {node.component for node in poses.values()} == {0}
    assert len(poses) == len(room.fragments)


def test_no_pair_is_proposed_where_that_is_not_wanted(tmp_path, room):
    write_bag(tmp_path / "bag", room.fragments[:2], [])
    config = load_config(None, [*SETTINGS, "registration.proposals.when=never"])
    run_mapping([tmp_path / "bag"], tmp_path / "log", config, timeout=400)
    assert read_log(tmp_path / "log").pairs == ()


def test_useless_fragments_are_answered_and_left_out(tmp_path, room):
    one_point = Fragment(FragmentId("1", 1, 90), np.ones((1, 3), np.float32))
    nothing_finite = Fragment(FragmentId("1", 1, 91), np.full((9, 3), np.nan, np.float32))
    pairs = [
        *room.pairs[:1],
        FragmentPair(one_point.id, room.fragments[0].id),
        FragmentPair(room.fragments[0].id, nothing_finite.id),
    ]
    write_bag(tmp_path / "bag", [*room.fragments[:2], one_point, nothing_finite], pairs)
    config = load_config(None, SETTINGS)
    run_mapping([tmp_path / "bag"], tmp_path / "log", config, timeout=400)
    result = read_log(tmp_path / "log")
    for pair in pairs[1:]:
        assert result.relative_transforms[pair].reason is Reason.TOO_FEW_POINTS
        assert result.relative_transforms[pair].message
    status = {node.id: node.status for node in result.pose_graph.nodes}
    assert status[one_point.id] is NodeStatus.UNPLACED
    assert status[room.fragments[0].id] is NodeStatus.PLACED


def test_what_nodes_warn_of_is_told_when_the_run_has_ended(tmp_path, room):
    """The foot of a tripod is not the place of its scanner."""
    first, second = room.fragments[:2]
    foot = Fragment(first.id, first.points + np.float32([0, 0, 1.4]), True)
    pairs = [pair for pair in room.pairs if {pair.source, pair.target} == {first.id, second.id}]
    warnings = {}
    for name, fragment in (("sensor", first), ("foot", foot)):
        write_bag(tmp_path / name, [fragment, second], pairs)
        config = load_config(None, SETTINGS)
        output = tmp_path / f"{name}_log"
        warnings[name] = run_mapping([tmp_path / name], output, config, timeout=400).warnings
    assert warnings["sensor"] == []
    assert len(warnings["foot"]) == 1
    assert str(first.id) in warnings["foot"][0]


def test_a_bag_that_is_not_there_is_named_before_anything_starts(tmp_path):
    with pytest.raises(BagError, match="nowhere"):
        run_mapping([tmp_path / "nowhere"], tmp_path / "log", load_config())
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize(
    ("namespace", "settings", "message"),
    [
        ("two words", [], "'two words' cannot be a namespace"),
        ("a//b", [], "'a//b' cannot be a namespace"),
        ("", ["registration.method=luck"], "no registration method 'luck'"),
        ("", ["pose_graph.synchronizer=luck"], "no synchronizer 'luck'"),
    ],
)
def test_what_no_node_could_use_is_named_before_anything_starts(
    tmp_path, room_bag, namespace, settings, message
):
    with pytest.raises(NssError, match=message):
        run_mapping([room_bag], tmp_path / "log", load_config(None, settings), namespace=namespace)
    assert not (tmp_path / "log").exists()


def test_an_existing_log_is_never_overwritten(tmp_path, room_bag):
    (tmp_path / "log").mkdir()
    with pytest.raises(RunError, match="exists already"):
        run_mapping([room_bag], tmp_path / "log", load_config())


def test_a_node_that_cannot_start_is_named(tmp_path, room_bag):
    config = load_config(None, [*SETTINGS, f"registration.seed={10**30}"])
    with pytest.raises(NodeError, match=r"Node registration ended.*'seed'"):
        run_mapping([room_bag], tmp_path / "log", config, timeout=100)


def _run_map(bag: Path, log: Path, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "nss_ros.cli.main", "map", str(bag), "-o", str(log), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _child(parent: int, module: str) -> int | None:
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (entry / "cmdline").read_bytes().decode().split("\0")
                ppid = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except (OSError, IndexError):
                continue
            if ppid == parent and f"nss_ros.nodes.{module}" in command:
                return int(entry.name)
    return None


def _wait_for_answers(log: Path, count: int) -> None:
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline:
        try:
            if len(read_log(log, points=False).relative_transforms) >= count:
                return
        except BagError:
            pass
        time.sleep(0.2)
    raise AssertionError(f"{log} did not get {count} answers")


@pytest.mark.parametrize("victim", ["recorder", "registration", "pose_graph", "fragment_player"])
def test_a_killed_node_is_named_and_the_log_survives(tmp_path, room_bag, victim):
    log = tmp_path / "log"
    run = _run_map(room_bag, log)
    _wait_for_answers(log, 3)
    os.kill(_child(run.pid, victim), signal.SIGKILL)
    _, errors = run.communicate(timeout=120)
    assert run.returncode == 1
    assert f"Node {victim} was killed by SIGKILL" in " ".join(errors.split())
    assert "Traceback" not in errors
    survived = read_log(log)
    assert len(survived.relative_transforms) >= 3
    assert survived.partial == (victim == "recorder")


def test_two_runs_do_not_mix(tmp_path, room_bag):
    runs = [_run_map(room_bag, tmp_path / name) for name in ("one", "two")]
    errors = [run.communicate(timeout=400)[1] for run in runs]
    statuses = [run.returncode for run in runs]
    assert sorted(statuses) == [0, 1]
    assert "Another graph is running here" in " ".join(errors[statuses.index(1)].split())


def test_nothing_outlives_a_killed_run(tmp_path, room_bag):
    log = tmp_path / "log"
    run = _run_map(room_bag, log)
    _wait_for_answers(log, 2)
    nodes = [_child(run.pid, name) for name in ("recorder", "registration", "pose_graph")]
    run.kill()
    run.communicate(timeout=120)
    deadline = time.monotonic() + 120
    while any(Path(f"/proc/{pid}").exists() for pid in nodes):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    survived = read_log(log)
    assert not survived.partial
    assert len(survived.relative_transforms) >= 2


def test_ctrl_c_closes_the_log(tmp_path, room_bag):
    log = tmp_path / "log"
    run = _run_map(room_bag, log)
    _wait_for_answers(log, 2)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=120)
    assert run.returncode == 130
    assert "Traceback" not in errors
    assert f"what was recorded until then is in {log}" in errors
    assert not read_log(log).partial
