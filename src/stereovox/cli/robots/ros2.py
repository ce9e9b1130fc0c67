# SPDX-License-Identifier: Apache-2.0
"""Map live ROS 2 topics.

Input: depth images with camera_info, point clouds and laser scans, poses from /tf or odometry. Output: a 2-D map, a
cloud, an OctoMap and diagnostics. All options and settings can also be given as parameters: docs/ros2.md.
"""

from __future__ import annotations

from argparse import REMAINDER, ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_settings, add_usual, overrides
from stereovox.cli.terminal import milliseconds, say, say_about_compiling

if TYPE_CHECKING:
    from stereovox.frame import UpdateReport
    from stereovox.ros.run import NodeRun

EXAMPLES = """stereovox ros2 --depth /camera/depth/image_rect_raw --out room.svox
stereovox ros2 --scan /scan --out floor.yaml"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    topics = (
        (
            "depth",
            "TOPIC[=INFO]",
            "depth images (16UC1, 32FC1, .../compressedDepth, .../compressed), and their camera_info",
        ),
        ("cloud", "TOPIC", "point clouds"),
        ("scan", "TOPIC", "laser scans"),
        ("range", "TOPIC", "distances of sonars or radars"),
        ("odometry", "TOPIC", "poses as nav_msgs/Odometry, besides /tf"),
        ("pose", "TOPIC=FRAME", "poses of a frame as geometry_msgs/PoseStamped"),
        ("fixed", "TEXT", "fixed pose of a frame: 'PARENT CHILD x y z yaw pitch roll'"),
    )
    for name, value, about in topics:
        parser.add_argument(f"--{name}", action="append", metavar=value, help=f"{about}; repeatable")
    about = (
        "given: from /tf and the options above; track: from the first depth camera by visual odometry; slam, or a "
        "MAP.yaml to localise the robot in, by its lidar (given)"
    )
    parser.add_argument("--poses", metavar="HOW", help=about)
    parser.add_argument("--lidar", metavar="TOPIC", help="laser scans that localise the robot (the first --scan)")
    parser.add_argument("--start", metavar="X,Y,DEG", help="first pose of the robot in MAP.yaml: metres and degrees")
    parser.add_argument("--slam-out", metavar="MAP", help="where to save SLAM's map at the end, for example floor.yaml")
    parser.add_argument("--reference", metavar="MAP", help="compare the 2-D map with this .yaml (the one of --poses)")
    about = "region of the reference that does not count; repeatable"
    parser.add_argument("--exclude", action="append", metavar="X0,Y0,X1,Y1", help=about)
    parser.add_argument("--world-frame", metavar="FRAME", help="frame of the map (map, else odom)")
    parser.add_argument("--base-frame", metavar="FRAME", help="frame of the robot (base_footprint, else base_link)")
    parser.add_argument("--corrected-path", metavar="TOPIC", help="correct the map by a SLAM program's nav_msgs/Path")
    parser.add_argument("--path-frame", metavar="FRAME", help="the frame whose poses these are (the first sensor's)")
    parser.add_argument(
        "--correct-jumps", action="store_true", help="spread jumps of odom in the map over the path since the last one"
    )
    about = "write launch file, parameters and displays for Nav2 there, and exit"
    parser.add_argument("--write-nav2", metavar="FOLDER", help=about)
    about = "Nav2's parameters to override with ours, with --write-nav2 (the sourced distribution's)"
    parser.add_argument("--nav2-params", metavar="FILE", help=about)
    about = "start as a managed node: configure and activate it by its lifecycle services"
    parser.add_argument("--lifecycle", action="store_true", help=about)
    parser.add_argument("--out", metavar="MAP", help="where to save the map at the end, and when the service is called")
    parser.add_argument("--load", metavar="MAP", help="continue this map")
    add_usual(parser, "profile", "voxel-size", "max-range")
    add_settings(parser, "sensor.model=andert")
    parser.add_argument(
        "--checkpoint", type=float, default=0.0, metavar="SECONDS", dest="checkpoint_s",
        help="save the map at this interval; frames wait meanwhile (0: only at the end)",
    )  # fmt: skip
    parser.add_argument(
        "--ros-args", nargs=REMAINDER, default=[], help="arguments for ROS 2, up to the end of the line"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Map until Ctrl-C or SIGTERM, save the map and print a summary."""
    if arguments.write_nav2:
        return _write_nav2(arguments)
    from stereovox.ros.library import check_installed

    check_installed()
    from stereovox.ros.library import running_node
    from stereovox.ros.lifecycle import Managed, managed_node

    if arguments.lifecycle:
        with running_node(arguments.ros_args, managed_node) as node:
            say("unconfigured: ros2 lifecycle set /stereovox configure, then activate; Ctrl-C ends")
            return Managed(node, lambda entities: _run_of(arguments, entities).__enter__()).finish()
    with running_node(arguments.ros_args) as node, _run_of(arguments, node) as map_run:
        say("listening; Ctrl-C ends")
        return map_run.finish()


def _run_of(arguments: Namespace, node: Any) -> NodeRun:
    """Return the run of a node with its present parameters, overridden by the command line."""
    from stereovox.config import load_config
    from stereovox.ros.options import PREFIX, Options, given_parameters, with_parameters
    from stereovox.ros.run import NodeOptions, NodeRun

    given, settings = given_parameters(node), overrides(arguments)
    given.options.update(
        {name.removeprefix(PREFIX): settings.pop(name) for name in [*settings] if name.startswith(PREFIX)}
    )
    profile = arguments.profile or given.settings.get("profile", "default")
    given.settings.pop("profile", None)
    config = load_config(profile, **{**given.settings, **settings})
    named = {one.name: getattr(arguments, one.name, None) for one in fields(Options)}
    given.options.update({name: value for name, value in named.items() if value})
    topics = with_parameters(Options(), given.options)
    say_about_compiling()
    given_to_run = {"checkpoint_s": arguments.checkpoint_s, "load": arguments.load or ""}
    return NodeRun(node, config, topics, NodeOptions(**given_to_run, notify=say, report=_print_result))


def _write_nav2(arguments: Namespace) -> dict[str, Any]:
    from stereovox.ros.nav2 import write_nav2

    paths = write_nav2(arguments.write_nav2, arguments.nav2_params)
    say(f"written: {', '.join(str(path) for path in paths)}; start them with: ros2 launch {paths[1]}")
    return {"written": [str(path) for path in paths]}


def _print_result(result: dict[str, Any], reports: Sequence[UpdateReport]) -> None:
    """Print the results of frames, localisation, SLAM and comparison."""
    say(f"{result['frames']} frames mapped, {result['frames_refused']} refused, {sum(result['dropped'].values())} late")
    for reason, number in result["refused"].items():
        example = next((f", last: {one.detail}" for one in reversed(reports) if one.refused == reason), "")
        say(f"  {number} x {reason}{example}")
    if not all(one.refused for one in reports):
        say(f"per frame: {milliseconds(result['frame_ms'])}")
    if "localisation" in result:
        refused = sum(result["localisation"]["refused"].values())
        say(f"localised by {result['localisation']['scans']} scans, {refused} refused")
    if "slam" in result:
        say(f"SLAM: {result['slam']['closures']} loops closed")
    if "error" in result:
        eq7, coverage, contradiction = result["error"].values()
        parts = f"coverage {coverage:.1f}, contradiction {contradiction:.1f}"
        say(f"error against the reference (Eq 7): {eq7:.1f} %, {parts}")
