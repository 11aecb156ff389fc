import collections
import os
import pickle
import sys

import pytest
import torch
from official_checkpoint import random_tensors, write_checkpoint
from safetensors.torch import save_file
from torch import nn

from nss_ros.errors import MethodError
from nss_ros.registration.learned.checkpoint import chosen_device, load_weights, read_weights

PUBLISHED = "https://example.org/weights"


def network():
    return nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))


def load(path):
    loaded = network()
    load_weights(loaded, str(path), "fcgf", PUBLISHED)
    return loaded


def refusal(path):
    with pytest.raises(MethodError) as raised:
        load(path)
    message = str(raised.value)
    assert message.endswith(".")
    assert "registration.fcgf.weights" in message
    return message


def assert_holds(loaded, tensors):
    found = loaded.state_dict()
    assert set(found) == set(tensors)
    assert all(torch.equal(found[name], tensors[name]) for name in tensors)


@pytest.fixture
def tensors():
    return random_tensors(network(), seed=1)


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.filterwarnings("error")
def test_a_checkpoint_of_the_authors(zipped, tensors, tmp_path):
    path = write_checkpoint(tmp_path / "weights.pth", tensors, zipped)
    assert "settings_of_the_authors" not in sys.modules
    loaded = load(path)
    assert_holds(loaded, tensors)
    assert not loaded.training
    assert not any(each.requires_grad for each in loaded.parameters())


@pytest.mark.parametrize("holder", ["state_dict", "model", "model_state_dict", None])
def test_where_tensors_are_kept(holder, tensors, tmp_path):
    content = collections.OrderedDict(tensors) if holder is None else {holder: tensors, "epoch": 1}
    torch.save(content, tmp_path / "weights.tar")
    assert_holds(load(tmp_path / "weights.tar"), tensors)


def test_parameters_half_precision_and_tensors_of_several_gpus(tensors, tmp_path):
    several = {f"module.{name}": each for name, each in tensors.items()}
    several["module.0.bias"] = nn.Parameter(tensors["0.bias"])
    several["module.0.weight"] = tensors["0.weight"].half()
    torch.save({"state_dict": several}, tmp_path / "weights.pth")
    expected = tensors | {"0.weight": tensors["0.weight"].half().float()}
    assert_holds(load(tmp_path / "weights.pth"), expected)


@pytest.mark.parametrize("prefix", ["", "module."])
def test_safetensors(prefix, tensors, tmp_path):
    save_file({prefix + name: each for name, each in tensors.items()}, tmp_path / "w.safetensors")
    assert_holds(load(tmp_path / "w.safetensors"), tensors)


def test_tensors_can_be_read_before_their_network_is_made(tensors, tmp_path):
    path = write_checkpoint(tmp_path / "weights.pth", tensors)
    found = read_weights(path, "fcgf", PUBLISHED)
    assert set(found) == set(tensors)
    assert found["0.weight"].shape == (4, 3)


def test_no_weights_are_given():
    message = refusal("")
    assert "'fcgf' needs trained weights" in message
    assert PUBLISHED in message


@pytest.mark.parametrize("name", ["none.pth", "none.safetensors"])
def test_a_file_that_is_not_there(name, tmp_path):
    assert f"There is no file {tmp_path / name}" in refusal(tmp_path / name)


@pytest.mark.parametrize("name", ["text.pth", "text.safetensors"])
@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04 nor a zip"])
def test_files_that_are_no_checkpoints(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert "is not a checkpoint of PyTorch" in refusal(tmp_path / name)


def test_a_folder_is_no_checkpoint(tmp_path):
    assert "is not a checkpoint of PyTorch" in refusal(tmp_path)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_truncated_checkpoint(zipped, tensors, tmp_path):
    path = tmp_path / "weights.pth"
    write_checkpoint(path, tensors, zipped)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "is not a checkpoint of PyTorch" in refusal(path)


@pytest.mark.parametrize("content", [[1, 2], {}, {"state_dict": {}}, {"epoch": 3}, torch.ones(2)])
def test_files_without_weights(content, tmp_path):
    torch.save(content, tmp_path / "weights.pth")
    assert "holds no weights" in refusal(tmp_path / "weights.pth")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda tensors: tensors.pop("0.weight"), "'0.weight' is missing"),
        (lambda tensors: tensors.update(other=torch.ones(1)), "'other' is not of this network"),
        (
            lambda tensors: tensors.update({"0.weight": torch.ones(5, 3)}),
            "'0.weight' is (5, 3) instead of (4, 3)",
        ),
        (lambda tensors: tensors.clear() or tensors.update(a=torch.ones(1)), "and 5 more"),
    ],
)
def test_weights_of_another_network(change, told, tensors, tmp_path):
    change(tensors)
    torch.save(tensors, tmp_path / "weights.pth")
    message = refusal(tmp_path / "weights.pth")
    assert "holds weights of another network" in message
    assert told in message


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite(value, tensors, tmp_path):
    tensors["0.bias"][1] = value
    torch.save(tensors, tmp_path / "weights.pth")
    assert "not finite ('0.bias')" in refusal(tmp_path / "weights.pth")


class Call:
    """Pickled as a call."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def calls(folder):
    """Things that leave a file in a folder if a reader of pickles makes them."""
    left = str(folder / "left")
    return {
        "os.system": Call(os.system, f"touch {left}"),
        "eval": Call(eval, f"open({left!r}, 'w').close()"),
        "open": Call(open, left, "w"),
        "mkdir": Call(os.mkdir, left),
    }


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("name", ["os.system", "eval", "open", "mkdir"])
def test_nothing_is_called(name, zipped, tensors, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    call = calls(folder)[name]
    path = write_checkpoint(tmp_path / "weights.pth", tensors, zipped, extra=call)
    assert_holds(load(path), tensors)
    bare = tmp_path / "bare.pth"
    bare.write_bytes(pickle.dumps(call))
    refusal(bare)
    assert list(folder.iterdir()) == []
    pickle.loads(bare.read_bytes())  # it would have been
    assert [each.name for each in folder.iterdir()] == ["left"]


def test_names_are_not_followed_into_modules(tmp_path):
    left, weights = tmp_path / "left", tmp_path / "weights.pth"
    texts = ("torch.serialization", "os.system", f"touch {left}")
    module, name, command = (b"\x8c" + bytes([len(each)]) + each.encode() for each in texts)
    program = b"\x80\x04" + module + name + b"\x93" + command + b"\x85R."
    weights.write_bytes(program)
    refusal(weights)
    assert not left.exists()
    pickle.loads(program)
    assert left.exists()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_program_of_torchscript_is_not_run(tmp_path):
    torch.jit.save(torch.jit.script(network()), tmp_path / "weights.pth")
    assert "TorchScript" in refusal(tmp_path / "weights.pth")


def test_devices():
    assert chosen_device("cpu").type == "cpu"
    assert chosen_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    if not torch.cuda.is_available():
        with pytest.raises(MethodError, match="no CUDA device"):
            chosen_device("cuda")
