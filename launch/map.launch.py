"""The whole graph: bags in, log out. The run goes on until it is interrupted or a node ends.

ros2 launch nss_ros map.launch.py bags:="['/data/stage1', '/data/stage2']" output:=/data/log
"""

from pathlib import Path
from typing import Any

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from nss_ros.config import PlayerConfig, RecorderConfig, RegistrationConfig, Section, validated
from nss_ros.errors import ConfigError

ARGUMENTS = {
    "bags": "rosbag2 MCAP bag, or a list of them",
    "output": "Folder of the log to write",
    "rate": "Speed against recorded time; 0: as fast as possible",
    "method": "Registration method; see 'nss methods'",
    "namespace": "Namespace of all four nodes",
    "params_file": "Parameters of the nodes, as far as no argument sets them",
}
TYPES = {"bags": list[str], "output": str, "rate": float, "method": str}


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; an empty one leaves what the parameter file says."""
    defaults = PathJoinSubstitution([FindPackageShare("nss_ros"), "config", "nss_ros.yaml"])
    default_values = {"rate": "", "method": "", "namespace": "", "params_file": defaults}
    arguments = [
        DeclareLaunchArgument(name, description=text, default_value=default_values.get(name))
        for name, text in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes)])


def nodes(context: LaunchContext) -> list[Node]:
    """Describe the four nodes; arguments are checked before any of them starts."""
    arguments = context.launch_configurations
    if not Path(arguments["params_file"]).is_file():
        raise ConfigError(f"There is no parameter file {arguments['params_file']}.")
    parameters = {
        "recorder": given(arguments, RecorderConfig, "output"),
        "pose_graph": {},
        "registration": given(arguments, RegistrationConfig, "method"),
        "fragment_player": given(arguments, PlayerConfig, "bags", "rate"),
    }
    return [
        Node(
            package="nss_ros",
            executable=executable,
            name=executable,
            namespace=arguments["namespace"],
            parameters=[arguments["params_file"], values],
            output="screen",
            on_exit=Shutdown(reason=f"{executable} ended"),
        )
        for executable, values in parameters.items()
    ]


def given(arguments: dict[str, str], model: type[Section], *names: str) -> dict[str, Any]:
    """Parameters from those of the named arguments that have a value."""
    values: dict[str, Any] = {name: arguments[name] for name in names if arguments[name]}
    if "bags" in values:
        bags = yaml.safe_load(values["bags"])
        values["bags"] = bags if isinstance(bags, list) else [values["bags"]]
    checked = validated(model, values, "the launch arguments")
    return {name: ParameterValue(getattr(checked, name), value_type=TYPES[name]) for name in values}
