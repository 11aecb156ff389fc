"""A benchmark in this process: what it gives, and what becomes of methods that misbehave."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nss_ros.bag import read_log, with_source_points
from nss_ros.bag_reader import encode
from nss_ros.batch.journal import Journal
from nss_ros.batch.registering import Workforce
from nss_ros.batch.run import Choice, run_benchmark
from nss_ros.batch.source import BatchSplit, DatasetSource, PairChoice
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.benchmark.score import score_log
from nss_ros.config import NssConfig, load_config
from nss_ros.dataset.annotate import pair_sets
from nss_ros.dataset.bag_export import export_bag
from nss_ros.dataset.splits import Split
from nss_ros.errors import InputError, MethodError, RunError
from nss_ros.messages import (
    relative_transform_from,
    relative_transform_message,
    rosbags_family,
)
from nss_ros.multiway.pose_graph import NodeStatus
from nss_ros.registration.pool import RegistrationPool
from nss_ros.registration.relative_transform import Reason

pytestmark = pytest.mark.usefixtures("plugins")

ALL = BatchSplit.ALL
QUICK = ["registration.fpfh.max_keypoints=300", "registration.fpfh.ransac_iterations=3000"]


def answers(log_path):
    """What was answered, without the seconds that it took."""
    log = read_log(log_path)
    return [told(log.relative_transforms[pair]) for pair in log.pairs]


def told(result):
    message = relative_transform_message(replace(result, compute_time=0.0), 0, rosbags_family())
    return encode(message)


def map_of(log_path):
    graph = read_log(log_path).pose_graph
    return [(n.id, n.status, n.component, n.T_map_fragment.tobytes()) for n in graph.nodes]


def go(dataset, output, methods=("guess",), splits=(ALL,), synchronizers=("choi",), **options):
    config = options.pop("config", NssConfig())
    force = Workforce(options.pop("workers", 1), memory_limit=options.pop("memory_limit", 1024))
    report = options.pop("report", lambda *_: None)
    choice = Choice(methods, splits, synchronizers, **options)
    return run_benchmark(DatasetSource(dataset), output, choice, config, force, report)


def test_a_pair_has_the_answer_that_the_graph_gives(dataset, tmp_path):
    """The node's pool, fed from a bag, against two joblib processes, fed from the dataset."""
    config = load_config(None, [*QUICK, "registration.seed=5", "registration.method=fpfh_ransac"])
    pairs = pair_sets(dataset, Split.CROSS_STAGE)["test"]
    few = pairs.take(pairs.selected)
    export_bag(tmp_path / "bag", dataset, few, 0.0)
    bag = read_log(tmp_path / "bag")
    pool = RegistrationPool(config.registration, workers=1)
    try:
        for fragment in bag.fragments.values():
            pool.add_fragment(fragment)
        for pair in bag.pairs:
            pool.submit(pair)
        expected = {}
        while len(expected) < len(few):
            expected |= {each.pair: each for each in pool.poll(0.1)}
    finally:
        pool.close()
    splits = (BatchSplit.CROSS_STAGE,)
    results = tmp_path / "results"
    (log,) = go(dataset, results, ("fpfh_ransac",), splits, config=config, workers=2).logs
    found = read_log(log.path).relative_transforms
    assert any(each.ok for each in expected.values())
    for pair, each in expected.items():
        message = relative_transform_message(each, 0, rosbags_family())
        assert told(relative_transform_from(message)) == told(found[pair])


def test_logs_tell_all_and_are_scored_like_those_of_the_graph(dataset, tmp_path):
    splits = (BatchSplit.CROSS_AREA, BatchSplit.CROSS_STAGE)
    config = load_config(None, ["registration.seed=4"])
    result = go(
        dataset, tmp_path / "results", splits=splits, synchronizers=("choi", "tree"),
        config=config, training="same_stage",
    )  # fmt: skip
    assert [log.path.name for log in result.logs] == [
        "cross_area-guess-choi", "cross_area-guess-tree",
        "cross_stage-guess-choi", "cross_stage-guess-tree",
    ]  # fmt: skip
    table = pair_sets(dataset, Split.CROSS_AREA)["test"]
    table = table.take(table.selected)
    log = read_log(result.logs[1].path)
    assert not log.partial
    assert list(log.pairs) == table.pairs
    assert set(log.relative_transforms) == set(table.pairs)
    evaluation = evaluate(with_source_points(log))
    assert evaluation.has_points
    assert evaluation.split == "cross_area"
    assert evaluation.training == "same_stage"
    assert (evaluation.method, evaluation.synchronizer) == ("guess", "tree")
    assert list(evaluation.edges.pairs) == table.pairs
    assert np.array_equal(evaluation.edges.overlap_ratio, table.overlap_ratio)
    score = score_log(log, Bootstrap(0))
    assert not score.partial
    assert (score.pairs, score.answered) == (len(table), len(table))
    recorded = json.loads(log.metadata["config"])
    assert recorded["registration"]["method"] == "guess"
    assert recorded["pose_graph"]["synchronizer"] == "tree"
    assert recorded["registration"]["seed"] == 4
    for name in ("nss_ros", "git_revision", "version_numpy", "generator_seed", "start_time"):
        assert log.metadata[name]
    assert float(log.metadata["benchmark.register_seconds"]) > 0
    # The folder may move.
    (tmp_path / "results").rename(tmp_path / "moved")
    moved = read_log(tmp_path / "moved" / "logs" / "cross_area-guess-choi")
    assert with_source_points(moved).fragments.keys() == set(dataset.fragment_ids())


def test_maps_of_all_areas_are_one_graph(dataset, tmp_path):
    (log,) = go(dataset, tmp_path / "results").logs
    graph = read_log(log.path).pose_graph
    assert [node.id for node in graph.nodes] == sorted({node.id for node in graph.nodes})
    assert {node.id.area for node in graph.nodes} == {"1", "2"}
    assert graph.synchronizer == "choi"
    members: dict[int, set] = {}
    for node in graph.nodes:
        if node.status is NodeStatus.PLACED:
            members.setdefault(node.component, set()).add(node.id)
        else:
            assert node.component == 0
    assert len(members) > 1
    sizes = [len(members[number]) for number in range(len(members))]
    assert sizes == sorted(sizes, reverse=True)
    for ids in members.values():
        assert len(ids) > 1
        assert len({id_.area for id_ in ids}) == 1


def test_workers_and_memory_make_no_difference_and_features_are_made_once(
    dataset, tmp_path, monkeypatch
):
    prepared = tmp_path / "prepared"
    monkeypatch.setenv("GUESS_PREPARED", str(prepared))
    (one,) = go(dataset, tmp_path / "one", workers=1).logs
    ids = prepared.read_text().split()
    assert sorted(ids) == sorted(set(ids))
    (two,) = go(dataset, tmp_path / "two", workers=2, memory_limit=0).logs
    assert answers(one.path) == answers(two.path)
    assert map_of(one.path) == map_of(two.path)


def test_what_a_method_raises_is_a_failed_result_with_its_reason(dataset, tmp_path):
    (log,) = go(dataset, tmp_path / "results", ("angry",)).logs
    results = read_log(log.path).relative_transforms
    reasons = set()
    for pair, result in results.items():
        reasons.add(result.message)
        if 1 in (pair.source.spot, pair.target.spot):
            assert result.reason is Reason.METHOD_ERROR
            assert "spot 1 is unspeakable" in result.message
        elif pair.source.spot == 2:
            assert result.message == "RuntimeError: spot 2 again"
        else:
            assert result.ok
    assert len(reasons) == 3
    assert score_log(read_log(log.path), Bootstrap(0)).failed > 0


@pytest.mark.parametrize("workers", [1, 2])
def test_a_pair_that_kills_its_workers_is_given_up(dataset, tmp_path, workers):
    splits = (BatchSplit.CROSS_STAGE,)
    result = go(dataset, tmp_path / "results", ("lethal",), splits, workers=workers)
    results = read_log(result.logs[0].path).relative_transforms
    kills = {pair for pair in results if (pair.source.stage, pair.source.spot) == (2, 2)}
    assert kills
    for pair, each in results.items():
        assert each.reason is (Reason.WORKER_DIED if pair in kills else Reason.NONE)
    assert result.timings[0].failed == sum(not each.ok for each in results.values())


def test_logs_appear_whole_or_not_at_all(dataset, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("nss_ros.batch.run_log._write", full)
        with pytest.raises(OSError, match="No space left"):
            go(dataset, tmp_path / "results")
    assert not list((tmp_path / "results").glob("logs/*"))
    (log,) = go(dataset, tmp_path / "results").logs
    assert not read_log(log.path).partial
    names = {path.name for path in (tmp_path / "results").iterdir()}
    assert names == {".lock", "benchmark.json", "fragments", "journal", "logs"}


def test_a_synchronizer_that_fails_costs_its_own_map_only(dataset, tmp_path):
    result = go(dataset, tmp_path / "results", synchronizers=("broken", "choi"))
    assert [log.synchronizer for log in result.logs] == ["choi"]
    assert "'broken'" in result.problems[0]
    assert "no map today" in result.problems[0]


def test_more_methods_and_splits_reuse_what_is_there(dataset, tmp_path):
    go(dataset, tmp_path / "results", splits=(BatchSplit.CROSS_AREA,))
    first = {p: p.stat().st_mtime_ns for p in (tmp_path / "results" / "logs").glob("*/*.mcap")}
    calls = []
    result = go(
        dataset, tmp_path / "results", ("guess", "angry"), (ALL, BatchSplit.CROSS_AREA),
        report=lambda *call: calls.append(call),
    )  # fmt: skip
    assert len(result.logs) == 4
    done = [count for name, count, _ in calls if name == "pairs guess"]
    table = pair_sets(dataset, Split.CROSS_AREA)["test"]
    assert done[0] == int(table.selected.sum())
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in first.items())


def test_a_run_that_is_complete_computes_nothing(dataset, tmp_path, monkeypatch):
    go(dataset, tmp_path / "results")
    files = sorted((tmp_path / "results").rglob("*"))
    monkeypatch.setattr("nss_ros.batch.registering.stream", None)
    monkeypatch.setattr("nss_ros.batch.run.run", None)
    (log,) = go(dataset, tmp_path / "results").logs
    assert sorted((tmp_path / "results").rglob("*")) == files
    assert log.path in files


@pytest.mark.parametrize("share", [0.0, 0.3, 0.45, 0.5])
def test_a_journal_that_was_cut_loses_its_end_only(dataset, tmp_path, share):
    whole = go(dataset, tmp_path / "whole").logs[0]
    expected = answers(whole.path), map_of(whole.path)
    folder = tmp_path / "cut"
    go(dataset, folder)
    for log in (folder / "logs").iterdir():
        log.rename(tmp_path / f"away_{log.name}")
    file = folder / "journal" / "0001" / "0001.mcap"
    with Journal(folder / "journal") as journal:
        count = len(journal.of("guess"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with Journal(folder / "journal") as journal:
        assert len(journal.of("guess")) < count
    (log,) = go(dataset, folder).logs
    assert (answers(log.path), map_of(log.path)) == expected


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"config": load_config(None, ["registration.seed=9"])}, "registration.seed is 0 there"),
        ({"config": load_config(None, ["pose_graph.preference=3"])}, "pose_graph.preference"),
        ({"pairs": PairChoice.OVERLAPPING}, "pairs is 'selected' there and 'overlapping' here"),
    ],
)
def test_a_folder_of_other_settings_is_refused(dataset, tmp_path, change, name):
    go(dataset, tmp_path / "results")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.mcap")}
    with pytest.raises(InputError, match=name):
        go(dataset, tmp_path / "results", **change)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.mcap")} == before


def test_foreign_folders_and_names_are_refused(dataset, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match=r"full holds files that are not of 'nss benchmark'"):
        go(dataset, tmp_path / "full")
    with pytest.raises(InputError, match="is not a folder"):
        go(dataset, tmp_path / "full" / "thesis.tex")
    with pytest.raises(MethodError, match=r"'magic'.*fpfh_ransac"):
        go(dataset, tmp_path / "results", ("magic",))
    with pytest.raises(MethodError, match=r"'sync'.*choi"):
        go(dataset, tmp_path / "results", synchronizers=("sync",))
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("options", "setting"),
    [
        ({"methods": ("predator",)}, "registration.predator.weights"),
        ({"synchronizers": ("posegraphnet",)}, "pose_graph.posegraphnet_weights"),
    ],
)
def test_weights_that_are_none_are_refused_before_a_pair_is_registered(
    dataset, tmp_path, options, setting
):
    none = load_config(None, [f"{setting}={tmp_path / 'none.pth'}"])
    with pytest.raises(MethodError, match=setting):
        go(dataset, tmp_path / "results", config=none, **options)
    assert not (tmp_path / "results").exists()


def test_two_benchmarks_do_not_share_a_folder(dataset, tmp_path):
    refusals = []

    def report(*_):
        if not refusals:
            with pytest.raises(RunError, match="Another 'nss benchmark' is writing") as refusal:
                go(dataset, tmp_path / "results")
            refusals.append(refusal)

    go(dataset, tmp_path / "results", report=report)
    assert refusals
