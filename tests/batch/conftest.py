"""A small simulated dataset, and a package of methods that a user's own would be like."""

import os
import sys
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor
from typer.testing import CliRunner

from nss_ros.cli.main import app
from nss_ros.dataset.folder import DatasetFolder

_SITE = """
areas:
  "1": {procedural: {width: 14, depth: 11, stages: 2}}
  "2": {procedural: {width: 14, depth: 11, stages: 2, use: residential}}
"""

_PACKAGE = '''
import os, signal, time
from dataclasses import replace
import numpy as np
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.choi import Choi
from nss_ros.registration.relative_transform import RelativeTransform

class Guess:
    """Takes its time; draws a pose for each fragment, and now and then another transform."""

    name = "guess"

    def __init__(self, config):
        pass

    def prepare(self, fragment):
        assert set(fragment.__slots__) == {"id", "points", "gravity_aligned"}
        with open(os.environ.get("GUESS_PREPARED", os.devnull), "a") as file:
            file.write(f"{fragment.id}\\n")
        rng = np.random.default_rng(int(np.abs(fragment.points).sum()))
        return fragment.id, from_yaw(rng.uniform(-3, 3), rng.uniform(-5, 5, 3))

    def register(self, source, target, seed):
        time.sleep(float(os.environ.get("GUESS_DELAY", "0")))
        rng = np.random.default_rng(seed)
        transform = relative(source[1], target[1])
        if rng.random() < 0.2:
            transform = from_yaw(rng.uniform(-3, 3), rng.uniform(-5, 5, 3))
        pair = FragmentPair(source[0], target[0])
        covariance = np.eye(6) * 1e-4
        return RelativeTransform(
            pair, self.name, transform, covariance, confidence=rng.uniform(0.6, 1.0), inliers=99
        )

class Angry(Guess):
    """Cannot describe spot 1, and raises at sources of spot 2."""

    name = "angry"

    def prepare(self, fragment):
        if fragment.id.spot == 1:
            raise ValueError("spot 1 is unspeakable")
        return super().prepare(fragment)

    def register(self, source, target, seed):
        if source[0].spot == 2:
            raise RuntimeError("spot 2 again")
        return super().register(source, target, seed)

class Lethal(Guess):
    """Kills the process that registers a source of spot 2, stage 2, unless GUESS_TAMED is set."""

    name = "lethal"

    def register(self, source, target, seed):
        tamed = os.environ.get("GUESS_TAMED")
        if (source[0].stage, source[0].spot) == (2, 2) and not tamed:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().register(source, target, seed)

class Tree:
    """Choi with another start."""

    name = "tree"

    def __init__(self, config):
        self._choi = Choi(config.model_copy(update={"start": "confidence"}))

    def synchronize(self, fragments, measurements):
        return replace(self._choi.synchronize(fragments, measurements), synchronizer=self.name)

def where(seconds):
    """The node of a Ray cluster, after a while."""
    import ray
    time.sleep(seconds)
    return seconds, ray.get_runtime_context().get_node_id()

def fail(number):
    raise InputError(f"Item {number} is not usable.")

class Broken:
    """Makes no map."""

    name = "broken"

    def __init__(self, config):
        pass

    def synchronize(self, fragments, measurements):
        raise ArithmeticError("no map today")
'''
_ENTRY_POINTS = """
[nss_ros.registration_methods]
guess = guess_methods:Guess
angry = guess_methods:Angry
lethal = guess_methods:Lethal

[nss_ros.synchronizers]
tree = guess_methods:Tree
broken = guess_methods:Broken
"""


@pytest.fixture(scope="session")
def dataset_path(tmp_path_factory) -> Path:
    """Two areas of two stages, with pairs and splits."""
    folder = tmp_path_factory.mktemp("batch")
    (folder / "site.yaml").write_text(_SITE)
    path = folder / "dataset"
    size = ["-s", "simulation.rig.image_width=60", "-s", "simulation.rig.image_height=45"]
    made = ["simulate", folder / "site.yaml", "-o", path, "--spots-per-stage", 4, "--seed", 3]
    for arguments in ([*made, *size, "--workers", 1], ["pairs", path, "--workers", 1]):
        result = CliRunner().invoke(app, [str(each) for each in arguments])
        assert result.exit_code == 0, result.output
    return path


@pytest.fixture
def dataset(dataset_path) -> DatasetFolder:
    return DatasetFolder(dataset_path)


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    """An installed package of registration methods and synchronizers."""
    folder = tmp_path / "site-packages"
    metadata = folder / "guess_methods-1.0.dist-info"
    metadata.mkdir(parents=True)
    (folder / "guess_methods.py").write_text(_PACKAGE)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: guess-methods\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(_ENTRY_POINTS)
    monkeypatch.syspath_prepend(folder)
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)
    # Processes of earlier tests do not know the package, those of this one not the next.
    get_reusable_executor().shutdown(wait=True)
    yield folder
    get_reusable_executor().shutdown(wait=True)
    sys.modules.pop("guess_methods", None)
