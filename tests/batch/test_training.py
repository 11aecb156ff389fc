"""Training on a dataset: what is learned from, what is saved, and what a benchmark makes of it."""

import json
import shutil

import pytest
import torch
from typer.testing import CliRunner

from nss_ros.bag import read_log
from nss_ros.batch.registering import Workforce
from nss_ros.batch.run import Choice, run_benchmark
from nss_ros.batch.source import BatchSplit, DatasetSource
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.cli.main import app
from nss_ros.config import PairConfig, SplitConfig, load_config
from nss_ros.dataset.annotate import add_pairs, pair_sets
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.splits import Split
from nss_ros.errors import FormatError, InputError, MethodError
from nss_ros.registration.learned.checkpoint import read_record
from nss_ros.registration.learned.training.example import training_pairs
from nss_ros.registration.learned.training.run import Training, train
from nss_ros.registration.method import load_method

VOXEL_SIZE = "registration.fcgf.voxel_size=0.3"
SETTINGS = [VOXEL_SIZE, "training.steps=4", "training.save_every=2", "training.validation_pairs=1"]


def trained(dataset, output, settings=(), report=lambda _: None, **options):
    options = {"split": Split.CROSS_STAGE, "same_stage_only": False, "seed": 1} | options
    config = load_config(None, [*SETTINGS, *settings])
    return train(Training(dataset, "fcgf", **options), output, config, report)


@pytest.fixture(scope="module")
def weights(dataset_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("training") / "fcgf.pth"
    trained(DatasetFolder(dataset_path), path, same_stage_only=True)
    return path


def test_test_pairs_are_never_learned_from(dataset):
    for split in Split:
        test = set(pair_sets(dataset, split)["test"].pairs)
        assert test
        for name in training_pairs(dataset, split, False, 0.0):
            assert not test & set(name)


def test_pairs_can_be_of_one_stage_only_and_must_overlap(dataset):
    every, _ = training_pairs(dataset, Split.ORIGINAL, False, 0.0)
    same, _ = training_pairs(dataset, Split.ORIGINAL, True, 0.0)
    assert same == [pair for pair in every if pair.same_stage]
    assert 0 < len(same) < len(every)
    table = pair_sets(dataset, Split.ORIGINAL)["train"]
    near, _ = training_pairs(dataset, Split.ORIGINAL, False, 0.5)
    assert near == table.take(table.overlap_ratio >= 0.5).pairs
    with pytest.raises(InputError, match=r"no training pairs .* training\.min_overlap"):
        training_pairs(dataset, Split.ORIGINAL, False, 1.0)


def test_a_training_that_was_cut_short_ends_with_the_same_weights(dataset, weights, tmp_path):
    def cut(report):
        if report.step == 3:
            raise KeyboardInterrupt

    output = tmp_path / "fcgf.pth"
    with pytest.raises(KeyboardInterrupt):
        trained(dataset, output, report=cut, same_stage_only=True)
    assert not output.exists()
    assert read_record(tmp_path / "fcgf.pth.partial") == read_record(weights)
    steps = []
    trained(dataset, output, report=lambda each: steps.append(each.step), same_stage_only=True)
    assert steps == [3, 4]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["fcgf.pth"]
    ours, theirs = (torch.load(each, weights_only=True) for each in (output, weights))
    assert ours["training"] == theirs["training"]
    for name, tensor in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], tensor), name


def test_what_was_begun_in_another_way_is_kept(dataset, tmp_path):
    output = tmp_path / "fcgf.pth"

    def cut(report):
        raise KeyboardInterrupt(report.step)

    with pytest.raises(KeyboardInterrupt):
        trained(dataset, output, report=cut)
    with pytest.raises(InputError, match="seed is 1 there and 2 here"):
        trained(dataset, output, seed=2)
    with pytest.raises(InputError, match=r"training\.batch is 1 there and 2 here"):
        trained(dataset, output, ["training.batch=2"])
    partial = tmp_path / "fcgf.pth.partial"
    partial.write_bytes(partial.read_bytes()[:1000])
    with pytest.raises(FormatError, match=r"fcgf\.pth\.partial cannot be read"):
        trained(dataset, output)


def test_an_output_that_is_there_or_cannot_be_is_refused_at_once(dataset, weights, tmp_path):
    with pytest.raises(InputError, match="is there already"):
        trained(dataset, weights)
    with pytest.raises(FormatError, match="Cannot write"):
        trained(dataset, tmp_path / "nowhere" / "fcgf.pth")


def test_a_method_that_cannot_be_trained_is_refused(dataset, tmp_path):
    training = Training(dataset, "fpfh_ransac", Split.CROSS_STAGE, False, 0)
    with pytest.raises(MethodError, match="'fpfh_ransac' cannot be trained here: choose one of"):
        train(training, tmp_path / "x.pth", load_config())
    assert not list(tmp_path.iterdir())


def test_weights_run_with_the_voxel_size_of_their_training_only(weights):
    config = [f"registration.fcgf.weights={weights}", "registration.method=fcgf"]
    with pytest.raises(MethodError, match=r"voxel size of 0\.3 m: set registration\.fcgf\.voxel"):
        load_method(load_config(None, config).registration)
    method = load_method(load_config(None, [*config, VOXEL_SIZE]).registration)
    assert method.training == read_record(weights)
    assert (method.training.split, method.training.stages) == ("cross_stage", "same_stage")


def benchmarked(dataset, weights, output, splits, training=""):
    quick = ["registration.fpfh.ransac_iterations=1000", "registration.fpfh.hypotheses=5"]
    config = load_config(None, [VOXEL_SIZE, f"registration.fcgf.weights={weights}", *quick])
    choice = Choice(("fcgf",), splits, (), training=training)
    return run_benchmark(
        DatasetSource(dataset), output, choice, config, Workforce(1, memory_limit=1024)
    )


def test_a_benchmark_tells_what_was_learned_from(dataset, weights, tmp_path):
    (log,) = benchmarked(dataset, weights, tmp_path / "out", (BatchSplit.CROSS_STAGE,)).logs
    assert evaluate(read_log(log.path)).training == "same_stage"


@pytest.mark.parametrize("split", [BatchSplit.ALL, BatchSplit.ORIGINAL])
def test_a_benchmark_refuses_pairs_that_were_learned_from(dataset, weights, tmp_path, split):
    splits = (BatchSplit.CROSS_STAGE, split)
    with pytest.raises(InputError, match=f"so pairs of the split '{split.value}' may be among"):
        benchmarked(dataset, weights, tmp_path / "out", splits)
    assert not (tmp_path / "out").exists()


def test_a_benchmark_refuses_pairs_that_were_divided_anew(dataset_path, weights, tmp_path):
    copy = tmp_path / "dataset"
    shutil.copytree(dataset_path, copy)
    add_pairs(DatasetFolder(copy), PairConfig(), SplitConfig(), seed=0, workers=1)  # as it was
    benchmarked(DatasetFolder(copy), weights, tmp_path / "same", (BatchSplit.CROSS_STAGE,))
    add_pairs(DatasetFolder(copy), PairConfig(), SplitConfig(), seed=9, workers=1)
    with pytest.raises(InputError, match="made anew since"):
        benchmarked(DatasetFolder(copy), weights, tmp_path / "out", (BatchSplit.CROSS_STAGE,))


def test_other_weights_of_the_same_name_are_other_settings(dataset, weights, tmp_path):
    own = tmp_path / "fcgf.pth"
    splits = (BatchSplit.CROSS_STAGE,)
    shutil.copy(weights, own)
    benchmarked(dataset, own, tmp_path / "out", splits)
    content = torch.load(own, weights_only=True)
    content["state_dict"]["final.bias"] += 1
    torch.save(content, own)
    with pytest.raises(InputError, match=r"plugins\.fcgf is .* with weights .* there"):
        benchmarked(dataset, own, tmp_path / "out", splits)


def test_the_command_trains_and_tells_how_to_use_the_weights(dataset_path, tmp_path):
    output = tmp_path / "fcgf.pth"
    settings = [each for setting in SETTINGS for each in ("-s", setting)]
    arguments = [
        "train",
        dataset_path,
        "-m",
        "fcgf",
        "-o",
        output,
        "--split",
        "cross_stage",
        "--json",
    ]
    result = CliRunner().invoke(app, [str(each) for each in (*arguments, *settings)])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["record"]["count"] > 0
    assert [each["step"] for each in told["losses"]] == [2, 4]
    assert set(told["losses"][0]["losses"]) == {"source", "target"}
    assert read_record(output).split == "cross_stage"
