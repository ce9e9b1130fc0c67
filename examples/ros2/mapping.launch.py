# SPDX-License-Identifier: Apache-2.0
"""A RealSense camera and stereovox: ros2 launch mapping.launch.py out:=room.svox

Needs realsense2_camera, something that tells where the camera is (odometry, SLAM, motion capture) on /tf, and
stereovox in the same environment.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

HERE = Path(__file__).resolve().parent


def generate_launch_description():
    """Return what `ros2 launch` starts."""
    camera = Node(
        package="realsense2_camera",
        executable="realsense2_camera_node",
        namespace="camera",
        name="camera",
        parameters=[{"enable_color": False, "enable_depth": True, "depth_module.depth_profile": "848x480x30"}],
    )
    mapping = ExecuteProcess(
        cmd=["stereovox", "ros2", "--ros-args", "--params-file", str(HERE / "mapping.yaml"),
             "-p", ["ros.out:=", LaunchConfiguration("out")]],
        sigterm_timeout="30",
        output="screen",
    )  # fmt: skip
    return LaunchDescription(
        [
            DeclareLaunchArgument("out", default_value="room.svox"),
            SetEnvironmentVariable("FASTDDS_DEFAULT_PROFILES_FILE", str(HERE / "large_images.xml")),
            camera,
            mapping,
        ]
    )
