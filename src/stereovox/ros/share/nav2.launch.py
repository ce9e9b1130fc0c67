# SPDX-License-Identifier: Apache-2.0
"""A mapping node and Nav2 that plans in its map: ros2 launch nav2.launch.py depth:=/camera/camera/depth/image_rect_raw

Written next to nav2_params.yaml by `stereovox ros2 --write-nav2 FOLDER`. Nav2's own map_server and AMCL are not
started: with `poses:=MAP.yaml lidar:=/scan` stereovox serves the map and localises the robot in it; with `poses:=given`
another node publishes map -> odom. Nav2's servers run in one container with `use_composition:=True`; the mapping node
is a Python process, which no container can hold. Other launch files can include this one with the same arguments.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, OpaqueFunction
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PARAMETERS = Path(__file__).resolve().with_name("nav2_params.yaml")
ARGUMENTS = {
    "depth": "/camera/camera/depth/image_rect_raw",
    "poses": "given",
    "lidar": "",
    "start": "",
    "out": "",
    "params_file": str(PARAMETERS),
    "namespace": "",
    "use_sim_time": "false",
    "autostart": "true",
    "use_composition": "False",
    "nav2": "true",
}
"""Arguments and their defaults. nav2: false starts the mapping node alone."""
OURS = ("depth", "poses", "lidar", "start", "out")
PASSED_ON = ("namespace", "use_sim_time", "autostart", "params_file", "use_composition")
"""Arguments of nav2_bringup's navigation_launch.py."""


def generate_launch_description():
    """Return the description for `ros2 launch`."""
    container = Node(
        condition=IfCondition(LaunchConfiguration("use_composition")),
        package="rclcpp_components",
        executable="component_container_isolated",
        name="nav2_container",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), {"autostart": LaunchConfiguration("autostart")}],
        remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
        output="screen",
    )
    declared = [DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=_mapping), container, OpaqueFunction(function=_nav2)])


def _mapping(context):
    """Return the process of the mapping node; empty options are omitted."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ("params_file", "use_sim_time", *OURS)}
    return [ExecuteProcess(cmd=mapping_command(given), sigterm_timeout="30", output="screen")]


def mapping_command(given):
    """Return the command that starts the mapping node. given: values of the arguments by name."""
    options = [word for name in OURS if given[name] for word in (f"--{name}", given[name])]
    parameters = ["--params-file", given["params_file"], "-p", f"use_sim_time:={given['use_sim_time']}"]
    return ["stereovox", "ros2", *options, "--ros-args", *parameters]


def _nav2(context):
    if LaunchConfiguration("nav2").perform(context).lower() != "true":
        return []
    launch_file = Path(get_package_share_directory("nav2_bringup")) / "launch" / "navigation_launch.py"
    passed = {name: LaunchConfiguration(name).perform(context) for name in PASSED_ON}
    return [IncludeLaunchDescription(PythonLaunchDescriptionSource(str(launch_file)), launch_arguments=passed.items())]
