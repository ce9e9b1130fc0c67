# SPDX-License-Identifier: Apache-2.0
"""Map live ROS 2 topics.

Depth images with camera_info, point clouds and laser scans in, poses from /tf or odometry; a 2-D map, a cloud, an
OctoMap and diagnostics out. All options and settings can also be given as parameters: docs/ros2.md.
"""

from __future__ import annotations

from argparse import REMAINDER, ArgumentParser, Namespace
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_settings, overrides
from stereovox.cli.terminal import milliseconds, say, say_about_compiling
from stereovox.errors import MapFileError
from stereovox.safe_io import FLOOR_ENDINGS, check_file, check_in_space

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.frame import UpdateReport
    from stereovox.ros.mapping import Mapping
    from stereovox.ros.node import MapNode
    from stereovox.ros.options import Options
    from stereovox.run import Checkpoints

EXAMPLE = "stereovox ros2 --depth /camera/depth/image_rect_raw --out room.svox"
MAX_REPORTS = 10_000
"""Number of last frames whose times are summarised at the end."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    topics = (
        ("depth", "TOPIC[=INFO]", "depth images (16UC1, 32FC1, .../compressedDepth), and their camera_info"),
        ("cloud", "TOPIC", "point clouds"),
        ("scan", "TOPIC", "laser scans, for a floor map (--set dimensions=2)"),
        ("odometry", "TOPIC", "poses as nav_msgs/Odometry, besides /tf"),
        ("pose", "TOPIC=FRAME", "poses of a frame as geometry_msgs/PoseStamped"),
        ("fixed", "TEXT", "fixed pose of a frame: 'PARENT CHILD x y z yaw pitch roll'"),
    )
    for name, value, about in topics:
        parser.add_argument(f"--{name}", action="append", metavar=value, help=f"{about}; repeatable")
    about = "those of /tf and the options above, or of the first depth camera, by its own images (given)"
    parser.add_argument("--poses", choices=("given", "track"), help=about)
    parser.add_argument("--world-frame", metavar="FRAME", help="frame of the map (map, else odom)")
    parser.add_argument("--base-frame", metavar="FRAME", help="frame of the robot (base_footprint, else base_link)")
    parser.add_argument("--corrected-path", metavar="TOPIC", help="correct the map by a SLAM program's nav_msgs/Path")
    parser.add_argument("--path-frame", metavar="FRAME", help="the frame whose poses these are (the first sensor's)")
    parser.add_argument(
        "--correct-jumps", action="store_true", help="spread jumps of odom in the map over the way since the last one"
    )
    parser.add_argument("--out", metavar="MAP", help="where to save the map at the end, and when the service is called")
    parser.add_argument("--load", metavar="MAP", help="continue this map")
    parser.add_argument("--profile", metavar="P", help="profile name or TOML file (default)")
    parser.add_argument("--voxel-size", type=float, metavar="M", help="cell size in metres")
    parser.add_argument("--max-range", type=float, metavar="M", help="largest depth in metres that is used")
    add_settings(parser, "sensor.model=andert")
    parser.add_argument(
        "--checkpoint", type=float, default=0.0, metavar="SECONDS",
        help="save the map at this interval; frames wait meanwhile (0: only at the end)",
    )  # fmt: skip
    parser.add_argument(
        "--ros-args", nargs=REMAINDER, default=[], help="arguments for ROS 2, up to the end of the line"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Map until Ctrl-C or SIGTERM, save the map and print a summary."""
    from stereovox.ros.library import check_installed

    check_installed()
    from stereovox.ros.library import running_node

    with running_node(arguments.ros_args) as node, ExitStack() as stack:
        from stereovox.pose_choice import TRACK
        from stereovox.ros.corrections import check_corrections
        from stereovox.ros.mapping import Mapping
        from stereovox.ros.options import freeze
        from stereovox.ros.services import check_continuable
        from stereovox.warm_up import warm_up

        config, options = _settings(arguments, node)
        options.check_sources(config.dimensions)
        check_corrections(options, config)
        _reserve(options.out, config.dimensions, stack)
        say_about_compiling()
        warm_up(config, options.poses == TRACK)
        tiles = Path(options.out).parent / f".{Path(options.out).name}-tiles" if options.out else None
        mapping = Mapping(config, options.heights, tiles)
        stack.callback(mapping.close)
        if arguments.load:
            check_continuable(arguments.load, options.poses == TRACK)
            mapping.load(arguments.load)
        freeze(node, options.out)
        return _map(arguments, node, mapping, options)


def _map(arguments: Namespace, node: Any, mapping: Mapping, options: Options) -> dict[str, Any]:
    from stereovox.ros.node import MapNode
    from stereovox.ros.options import OUT
    from stereovox.run import Checkpoints, interrupt_between_steps

    reports: deque[UpdateReport] = deque(maxlen=MAX_REPORTS)

    def out() -> str:
        return str(node.get_parameter(OUT).value)

    map_node = MapNode(node, mapping, options, out, reports.append)
    checkpoints = Checkpoints(lambda: mapping.save(out()), options.out, arguments.checkpoint if options.out else 0.0)
    say("listening; Ctrl-C ends")
    with interrupt_between_steps() as check:
        try:
            with suppress(KeyboardInterrupt):
                while True:
                    map_node.spin_once()
                    check()
                    _checkpoint(checkpoints, mapping.history.frames, node)
            map_node.close()  # still under `check`: a second signal, as `timeout` sends it, must not interrupt this
        except Exception:  # whatever failed, the map so far is saved
            _save(mapping, out())
            raise
        return _print_result(map_node, mapping, out(), reports)


def _checkpoint(checkpoints: Checkpoints, frames: int, node: Any) -> None:
    """Save the map if a checkpoint is due; a full disk is logged and does not stop the robot."""
    try:
        if frames:
            checkpoints.after(frames)
    except MapFileError as error:
        node.get_logger().error(str(error), throttle_duration_sec=10.0)


def _print_result(map_node: MapNode, mapping: Mapping, out: str, reports: deque[UpdateReport]) -> dict[str, Any]:
    from stereovox.evaluate.summary import percentiles

    mapped = [one for one in reports if not one.refused]
    result = {
        "frames": mapping.history.frames,
        "frames_refused": mapping.history.refused.total(),
        "refused": dict(mapping.history.refused.most_common()),
        "received": dict(map_node.received),
        "dropped": dict(map_node.waiting.dropped),
        "frame_ms": percentiles([one.match_ms + one.depth_ms + one.integrate_ms for one in mapped]),
        "out": "",
    }
    say(f"{result['frames']} frames mapped, {result['frames_refused']} refused, {sum(result['dropped'].values())} late")
    for reason, number in result["refused"].items():
        example = next((f", last: {one.detail}" for one in reversed(reports) if one.refused == reason), "")
        say(f"  {number} x {reason}{example}")
    if mapped:
        say(f"a frame: {milliseconds(result['frame_ms'])}")
    if _save(mapping, out):
        result["out"] = out
    elif out:
        say("no frame could be used: no map is written")
    return result


def _save(mapping: Mapping, out: str) -> bool:
    """Save the map if it holds a frame and `out` is given; return whether it was saved."""
    if not (out and mapping.history.frames):
        return False
    mapping.save(out)
    say(f"saved in {out}")
    return True


def _settings(arguments: Namespace, node: Any) -> tuple[Config, Options]:
    """Return the settings of the map and the options of the node; the command line overrides parameters."""
    from stereovox.config import load_config
    from stereovox.ros.options import LISTS, Options, given_parameters, with_parameters

    given = given_parameters(node)
    profile = arguments.profile or given.settings.pop("profile", "default")
    given.settings.pop("profile", None)
    config = load_config(profile, **{**given.settings, **overrides(arguments)})
    corrections = "corrected_path", "path_frame", "correct_jumps"
    names = *LISTS, "poses", "world_frame", "base_frame", *corrections, "out"
    named = {name: getattr(arguments, name) for name in names}
    given_options = {name: value for name, value in named.items() if value}
    return config, with_parameters(Options(), {**given.options, **given_options})


def _reserve(out: str, dimensions: int, stack: ExitStack) -> None:
    """Check that the map can be saved, and keep others from writing there."""
    from stereovox.maps.lock import only_writer_in, only_writer_of_floor
    from stereovox.maps.store import check_target, sweep

    if out and dimensions == 2:
        stack.enter_context(only_writer_of_floor(check_file(out, FLOOR_ENDINGS)))
    elif out:
        check_in_space(out)
        check_target(Path(out))
        stack.enter_context(only_writer_in(Path(out)))
        sweep(Path(out))
