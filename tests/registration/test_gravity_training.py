"""The training command, from datasets to weights that register."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from nss_ros.cli.main import app
from nss_ros.config import RegistrationConfig
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.errors import InputError
from nss_ros.registration.gravity.train import main
from nss_ros.registration.gravity.training_data import ExampleSource, read_items
from nss_ros.registration.gravity.weights import load_network
from nss_ros.registration.method import load_method

_SITE = """
areas:
  "1": {procedural: {width: 14, depth: 11, stages: 2}}
  "2": {procedural: {width: 14, depth: 11, stages: 2, use: residential}}
"""

FEW = (
    *("--verifier-pairs", 4),
    *("--comparison-pairs", 4, "--comparison-steps", 2),
    *("--workers", 1),
)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    (folder / "site.yaml").write_text(_SITE)
    for seed in (1, 2, 3):
        command = ["simulate", str(folder / "site.yaml"), "-o", str(folder / f"{seed}")]
        options = ["--seed", str(seed), "--spots-per-stage", "3", "--no-labels", "--workers", "1"]
        result = CliRunner().invoke(app, command + options)
        assert result.exit_code == 0, result.output
    return [folder / str(seed) for seed in (1, 2, 3)]


def train(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["train", *map(str, arguments)])
    main()


def of(datasets):
    """One for the network, one for the second look, one for the verifier."""
    return datasets[0], "--comparison", datasets[1], "--verifier", datasets[2]


def test_training_gives_weights_that_are_reproducible_and_usable(monkeypatch, tmp_path, datasets):
    files = [tmp_path / "one.safetensors", tmp_path / "other.safetensors"]
    for file in files:
        options = ("--steps", 2, *FEW)
        train(monkeypatch, *of(datasets), "-o", file, *options)
    assert files[0].read_bytes() == files[1].read_bytes()
    config = RegistrationConfig(method="gravity", gravity={"weights": str(files[0])})
    method, dataset = load_method(config), DatasetFolder(datasets[1])
    source, target = (method.prepare(dataset.fragment(i)) for i in dataset.fragment_ids()[:2])
    assert method.register(source, target, 0).ok


def test_training_goes_on_from_other_weights(monkeypatch, tmp_path, datasets):
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    options = FEW
    train(monkeypatch, *of(datasets), "-o", first, "--steps", 2, *options)
    further = ("--start", first, "--seed", 5, "--steps", 1)
    train(monkeypatch, *of(datasets), "-o", second, *further, *options)
    one, other = load_network(first).state_dict(), load_network(second).state_dict()
    # Another seed would begin with other weights.
    assert all(torch.allclose(one[name], other[name], atol=0.01) for name in one)
    assert any(not torch.equal(one[name], other[name]) for name in one)
    none = tmp_path / "none.safetensors"
    with pytest.raises(SystemExit, match="error: "):
        train(monkeypatch, *of(datasets), "-o", second, "--start", none, *options)


def test_datasets_without_fragments_that_overlap_not_are_told(datasets):
    items = read_items(datasets[:1], RegistrationConfig(), 1)[:2]
    together = [replace(item, T_map_fragment=np.eye(4)) for item in items]
    with pytest.raises(InputError, match="do not overlap"):
        ExampleSource(together, 0).draw_apart()


def test_each_network_needs_datasets_of_its_own(monkeypatch, tmp_path, datasets, capsys):
    output = ("-o", tmp_path / "weights.safetensors")
    with pytest.raises(SystemExit):
        train(monkeypatch, datasets[0], *output)
    assert "--verifier, --comparison" in capsys.readouterr().err
    same = datasets[0] / ".." / datasets[0].name
    for groups in (
        (datasets[0], "--comparison", datasets[1], "--verifier", same),
        (datasets[0], "--comparison", same, "--verifier", datasets[1]),
        (datasets[1], "--comparison", datasets[0], "--verifier", same),
    ):
        with pytest.raises(SystemExit):
            train(monkeypatch, *groups, *output)
        assert f"must not learn from the same dataset: {datasets[0]}" in capsys.readouterr().err


def test_a_folder_that_is_no_dataset_is_one_sentence(monkeypatch, tmp_path, datasets):
    with pytest.raises(SystemExit, match="error: "):
        train(monkeypatch, tmp_path, *of(datasets)[1:], "-o", tmp_path / "weights.safetensors")
