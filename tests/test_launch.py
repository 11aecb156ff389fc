"""The launch file and the parameter file that it loads."""

import importlib.util
from pathlib import Path

import pytest
import yaml

from nss_ros.config import NssConfig, PlayerConfig, Section, validated
from nss_ros.errors import ConfigError

_ROOT = Path(__file__).parents[1]
_PARAMETERS = _ROOT / "config" / "nss_ros.yaml"
_SECTIONS = {"fragment_player": PlayerConfig} | {
    name: NssConfig.model_fields[name].annotation
    for name in ("registration", "pose_graph", "recorder")
}


def test_the_parameter_file_names_all_nodes_in_any_namespace():
    assert set(yaml.safe_load(_PARAMETERS.read_text())) == {f"/**/{name}" for name in _SECTIONS}


@pytest.mark.parametrize("node", _SECTIONS)
def test_the_parameter_file_holds_valid_parameters(node: str):
    parameters = yaml.safe_load(_PARAMETERS.read_text())[f"/**/{node}"]["ros__parameters"]
    section = validated(_SECTIONS[node], parameters, str(_PARAMETERS))
    assert isinstance(section, Section)
    assert section.model_fields_set == set(parameters)


@pytest.fixture
def launch_file():
    pytest.importorskip("launch_ros")
    path = _ROOT / "launch" / "map.launch.py"
    spec = importlib.util.spec_from_file_location("map_launch", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def context():
    """A launch with the two arguments that have no default, and the parameter file of this tree."""
    launch = pytest.importorskip("launch")
    context = launch.LaunchContext()
    arguments = {"bags": "/data/1", "output": "/data/2026", "params_file": str(_PARAMETERS)}
    context.launch_configurations.update(arguments)
    return context


def _nodes(launch_file, context) -> list:
    *arguments, nodes = launch_file.generate_launch_description().entities
    for argument in arguments:
        argument.execute(context)
    return nodes.execute(context)


def test_the_launch_file_describes_the_four_nodes(launch_file, context):
    nodes = _nodes(launch_file, context)
    assert {node.node_package for node in nodes} == {"nss_ros"}
    assert {node.node_executable for node in nodes} == set(_SECTIONS)


def test_arguments_that_are_not_given_leave_the_parameter_file(launch_file, context):
    _nodes(launch_file, context)
    given = launch_file.given(context.launch_configurations, PlayerConfig, "bags", "rate")
    assert set(given) == {"bags"}


@pytest.mark.parametrize(
    ("bags", "read"),
    [("/data/1", ["/data/1"]), ("['/data/1', '2026']", ["/data/1", "2026"])],
)
def test_bags_are_one_path_or_a_list(launch_file, context, bags: str, read: list[str]):
    arguments = {"bags": bags, "rate": "2"}
    given = launch_file.given(arguments, PlayerConfig, "bags", "rate")
    assert list(given["bags"].evaluate(context)) == read
    assert given["rate"].evaluate(context) == 2.0


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("rate", "fast", "'rate' in the launch arguments"),
        ("bags", "[1]", "'bags.0' in the launch arguments"),
        ("params_file", "/nowhere.yaml", "no parameter file /nowhere.yaml"),
    ],
)
def test_wrong_arguments_are_named_before_a_node_starts(
    launch_file, context, argument: str, value: str, message: str
):
    context.launch_configurations[argument] = value
    with pytest.raises(ConfigError, match=message):
        _nodes(launch_file, context)
