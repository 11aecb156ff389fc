"""The ./nss script, its pinned packages, and what the package files promise."""

import ast
import json
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Collection
from importlib.metadata import entry_points, packages_distributions, requires
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).parents[1]
COMPILERS = {"cc", "gcc", "clang", "c++", "g++", "clang++"}


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A copy of what ./nss needs to start a set-up, with no environment in it."""
    clone = tmp_path / "clone with spaces"
    clone.mkdir()
    for name in ("bootstrap", "nss_msgs", "requirements"):
        shutil.copytree(ROOT / name, clone / name)
    for name in ("nss", "setup.py", "setup.cfg"):
        shutil.copy2(ROOT / name, clone / name)
    return clone


def run_nss(
    clone: Path, hidden: Collection[str] = (), **variables: str
) -> subprocess.CompletedProcess[str]:
    """Runs ./nss with the machine's commands, less the hidden ones, and the given variables."""
    tools = clone.parent / "tools"
    tools.mkdir()
    for command in Path("/usr/bin").iterdir():
        if command.name not in {*hidden, "python3"}:
            (tools / command.name).symlink_to(command)
    (tools / "python3").symlink_to(sys.executable)
    environment = {"PATH": str(tools), "HOME": str(clone.parent), **variables}
    return subprocess.run(
        [str(clone / "nss"), "--version"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_missing_c_compiler_is_one_sentence(clone: Path) -> None:
    result = run_nss(clone, hidden=COMPILERS)
    assert result.returncode == 1
    assert "needs a C compiler" in result.stderr
    assert "build-essential" in result.stderr
    assert not (clone / ".venv").exists()


def test_compiler_that_does_not_work_is_named(clone: Path) -> None:
    result = run_nss(clone, CXX="false")
    assert result.returncode == 1
    assert "needs a C++ compiler" in result.stderr


def test_unsuitable_python_is_one_sentence(clone: Path) -> None:
    result = run_nss(clone, NSS_PYTHON="/bin/false")
    assert result.returncode == 1
    assert "NSS_PYTHON is '/bin/false', which is not a working Python" in result.stderr


def test_foreign_virtual_environment_is_left_alone(clone: Path) -> None:
    precious = clone / ".venv" / "precious"
    precious.parent.mkdir()
    precious.touch()
    result = run_nss(clone)
    assert result.returncode == 1
    assert "was not made by nss" in result.stderr
    assert precious.exists()


def test_every_requirement_is_pinned() -> None:
    def names(file: str) -> set[str]:
        lines = (ROOT / "requirements" / file).read_text().splitlines()
        return {re.split(r"[=\[]", line)[0] for line in lines if line and not line.startswith("#")}

    assert names("requirements.txt") <= names("constraints.txt")


def test_package_files_agree_on_the_version() -> None:
    manifests = [ROOT / "package.xml", ROOT / "nss_msgs" / "package.xml"]
    versions = {ET.parse(path).getroot().findtext("version") for path in manifests}
    setup = re.search(r'version="([\d.]+)"', (ROOT / "setup.py").read_text())
    assert setup is not None
    assert versions == {setup[1]}


@pytest.mark.parametrize("group", ["nss_ros.registration_methods", "nss_ros.synchronizers"])
def test_plugin_entry_points_load(group: str) -> None:
    points = entry_points(group=group)
    assert points
    for point in points:
        assert callable(point.load())


def test_tf2_msgs_has_the_official_type_hash() -> None:
    pytest.importorskip("tf2_msgs")
    packages = pytest.importorskip("ament_index_python.packages")
    share = Path(packages.get_package_share_directory("tf2_msgs"))
    hashes = json.loads((share / "msg" / "TFMessage.json").read_text())["type_hashes"]
    official = get_typestore(Stores.ROS2_JAZZY).hash_rihs01("tf2_msgs/msg/TFMessage")
    assert {h["type_name"]: h["hash_string"] for h in hashes}["tf2_msgs/msg/TFMessage"] == official


@pytest.fixture
def environment_file() -> Path:
    path = ROOT / ".nss" / "environment.sh"
    if not path.exists():
        pytest.skip("not set up by ./nss")
    return path


@pytest.mark.parametrize(("asked", "result"), [(None, "LOCALHOST"), ("SUBNET", "SUBNET")])
def test_discovery_stays_on_this_machine_unless_asked(
    environment_file: Path, asked: str | None, result: str
) -> None:
    variables = {"ROS_AUTOMATIC_DISCOVERY_RANGE": asked} if asked else {}
    assert sourced(environment_file, "ROS_AUTOMATIC_DISCOVERY_RANGE", variables) == result


@pytest.mark.parametrize(("ament_prefix", "kept"), [("/opt/ros/jazzy", False), (None, True)])
def test_python_path_of_a_sourced_ros_is_dropped(
    environment_file: Path, ament_prefix: str | None, kept: bool
) -> None:
    variables = {"PYTHONPATH": "/foreign"} | (
        {"AMENT_PREFIX_PATH": ament_prefix} if ament_prefix else {}
    )
    assert ("/foreign" in sourced(environment_file, "PYTHONPATH", variables).split(":")) is kept


def sourced(file: Path, name: str, variables: dict[str, str]) -> str:
    """The value of a variable after the file is sourced where only the given ones are set."""
    result = subprocess.run(
        ["bash", "-euc", '. "$0"; printf %s "${!1}"', str(file), name],
        env={"PATH": "/usr/bin:/bin", **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout


def third_party_imports() -> dict[str, Path]:
    """Top-level modules that nss_ros imports, less Python's and ROS's, each with a file of it."""
    found: dict[str, Path] = {}
    for file in sorted((ROOT / "nss_ros").rglob("*.py")):
        if "nodes" in file.parts:
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [str(node.module)]
            found |= {name.split(".")[0]: file for name in names}
    return {
        name: file
        for name, file in found.items()
        if name not in sys.stdlib_module_names and name != "nss_ros"
    }


def test_pip_install_brings_all_that_the_core_imports() -> None:
    def plain(name: str) -> str:
        return re.split(r"[^a-z0-9-]", name.lower().replace("_", "-"))[0]

    declared = {plain(each) for each in requires("nss_ros") or []}
    declared |= {"open3d-cpu"}  # of ./nss, the same module in a smaller wheel
    imports = third_party_imports()
    assert {"numpy", "open3d", "ifcopenshell", "torch"} <= imports.keys()
    installed = packages_distributions()
    missing = {
        module: str(file.relative_to(ROOT))
        for module, file in imports.items()
        if not declared & {plain(each) for each in installed.get(module, [module])}
    }
    assert missing == {}
    assert "open3d" in declared
