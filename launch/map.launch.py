"""The whole graph: bags in, log out. The run goes on until it is interrupted.

ros2 launch nss_ros map.launch.py bags:="['/data/stage1', '/data/stage2']" output:=/data/log
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe the four nodes; every setting not given here comes from the parameter file."""
    parameters = LaunchConfiguration("params_file")
    arguments = [
        DeclareLaunchArgument("bags", description="List of rosbag2 MCAP bags"),
        DeclareLaunchArgument("output", description="Folder of the log to write"),
        DeclareLaunchArgument("rate", default_value="0.0", description="0: as fast as possible"),
        DeclareLaunchArgument("method", default_value="fpfh_ransac"),
        DeclareLaunchArgument("namespace", default_value=""),
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution(
                [FindPackageShare("nss_ros"), "config", "nss_ros.yaml"]
            ),
        ),
    ]

    def node(executable: str, **overrides: object) -> Node:
        return Node(
            package="nss_ros",
            executable=executable,
            name=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[parameters, overrides],
            output="screen",
        )

    return LaunchDescription(
        [
            *arguments,
            node("recorder", output=ParameterValue(LaunchConfiguration("output"), value_type=str)),
            node("pose_graph"),
            node(
                "registration",
                method=ParameterValue(LaunchConfiguration("method"), value_type=str),
            ),
            node(
                "fragment_player",
                bags=ParameterValue(LaunchConfiguration("bags"), value_type=list[str]),
                rate=ParameterValue(LaunchConfiguration("rate"), value_type=float),
            ),
        ]
    )
