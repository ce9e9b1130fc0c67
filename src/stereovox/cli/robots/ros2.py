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
from stereovox.cli.terminal import but_few, milliseconds, say, say_about_compiling
from stereovox.errors import MapFileError
from stereovox.files.safe_io import FLOOR_ENDINGS, check_file, check_in_space

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.frame import UpdateReport
    from stereovox.ros.mapping import Mapping
    from stereovox.ros.node import MapNode
    from stereovox.ros.options import Options
    from stereovox.runs.recording import Checkpoints

EXAMPLES = """stereovox ros2 --depth /camera/depth/image_rect_raw --out room.svox
stereovox ros2 --scan /scan --out floor.yaml"""
MAX_REPORTS = 10_000
"""Number of last frames whose times are summarised at the end."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    topics = (
        ("depth", "TOPIC[=INFO]", "depth images (16UC1, 32FC1, .../compressedDepth), and their camera_info"),
        ("cloud", "TOPIC", "point clouds"),
        ("scan", "TOPIC", "laser scans"),
        ("odometry", "TOPIC", "poses as nav_msgs/Odometry, besides /tf"),
        ("pose", "TOPIC=FRAME", "poses of a frame as geometry_msgs/PoseStamped"),
        ("fixed", "TEXT", "fixed pose of a frame: 'PARENT CHILD x y z yaw pitch roll'"),
    )
    for name, value, about in topics:
        parser.add_argument(f"--{name}", action="append", metavar=value, help=f"{about}; repeatable")
    about = (
        "given: those of /tf and the options above; track: of the first depth camera, by its own images; slam, or the "
        "MAP.yaml that the robot is localised in, by its lidar (given)"
    )
    parser.add_argument("--poses", metavar="HOW", help=about)
    parser.add_argument("--lidar", metavar="TOPIC", help="laser scans that tell where the robot is (the first --scan)")
    parser.add_argument("--start", metavar="X,Y,DEG", help="first pose of the robot in MAP.yaml: metres and degrees")
    parser.add_argument("--slam-out", metavar="MAP", help="where to save SLAM's map at the end, for example floor.yaml")
    parser.add_argument("--reference", metavar="MAP", help="compare the 2-D map with this .yaml (that of --poses)")
    about = "region of the reference that does not count; repeatable"
    parser.add_argument("--exclude", action="append", metavar="X0,Y0,X1,Y1", help=about)
    parser.add_argument("--world-frame", metavar="FRAME", help="frame of the map (map, else odom)")
    parser.add_argument("--base-frame", metavar="FRAME", help="frame of the robot (base_footprint, else base_link)")
    parser.add_argument("--corrected-path", metavar="TOPIC", help="correct the map by a SLAM program's nav_msgs/Path")
    parser.add_argument("--path-frame", metavar="FRAME", help="the frame whose poses these are (the first sensor's)")
    parser.add_argument(
        "--correct-jumps", action="store_true", help="spread jumps of odom in the map over the way since the last one"
    )
    about = "write launch file, parameters and displays for Nav2 there, and end"
    parser.add_argument("--write-nav2", metavar="FOLDER", help=about)
    about = "Nav2's parameters to lay ours over, with --write-nav2 (those of the sourced distribution)"
    parser.add_argument("--nav2-params", metavar="FILE", help=about)
    about = "start as a managed node: configure and activate it by its lifecycle services"
    parser.add_argument("--lifecycle", action="store_true", help=about)
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
    if arguments.write_nav2:
        return _write_nav2(arguments)
    from stereovox.ros.library import check_installed

    check_installed()
    from stereovox.ros.library import running_node

    if arguments.lifecycle:
        return _run_managed(arguments)
    with running_node(arguments.ros_args) as node, ExitStack() as stack:
        return _map(_Run(arguments, node, stack))


def _run_managed(arguments: Namespace) -> dict[str, Any]:
    """Do as the node's transitions say, until it is shut down or Ctrl-C or SIGTERM."""
    from stereovox.ros.library import running_node
    from stereovox.ros.lifecycle import Managed, managed_node
    from stereovox.runs.recording import interrupt_between_steps

    with running_node(arguments.ros_args, managed_node) as node:
        managed = Managed(node, lambda entities: _Run(arguments, entities, ExitStack()))
        say("unconfigured: ros2 lifecycle set /stereovox configure, then activate; Ctrl-C ends")
        with interrupt_between_steps() as check:
            with suppress(KeyboardInterrupt):
                while not managed.ended:
                    managed.spin_once()
                    check()
            managed.close()
        return managed.report


class _Run:
    """A map that is made from now on. stack: is closed when it ends, or cannot begin."""

    def __init__(self, arguments: Namespace, node: Any, stack: ExitStack):
        with stack:
            self._begin(arguments, node, stack)
            self._stack = stack.pop_all()

    def _begin(self, arguments: Namespace, node: Any, stack: ExitStack) -> None:
        from stereovox.ros.node import MapNode
        from stereovox.ros.options import OUT, freeze
        from stereovox.runs.recording import Checkpoints

        self.node, self.reports = node, deque[Any](maxlen=MAX_REPORTS)
        self.mapping, self.options = _prepare(arguments, node, stack)
        stack.callback(freeze(node, self.options.out))
        self.out = lambda: str(node.get_parameter(OUT).value)
        self.map_node = MapNode(node, self.mapping, self.options, self.out, self.reports.append)
        period_s = arguments.checkpoint if self.options.out else 0.0
        self._checkpoints = Checkpoints(lambda: self.mapping.save(self.out()), self.options.out, period_s)

    def step(self) -> None:
        """Save the map if a checkpoint is due."""
        _checkpoint(self._checkpoints, self.mapping.history.frames, self.node)

    def end(self) -> dict[str, Any]:
        """Map what waits, save the map and print a summary; whatever fails, the map so far is saved."""
        with self._stack:
            try:
                ended = self.map_node.close()
            except Exception:
                self.save()
                raise
            try:
                result = _print_result(self.map_node, self.mapping, self.out(), self.reports)
            finally:  # SLAM's map is kept where the other one cannot be
                more = _print_ended(ended, self.options.slam_out)
            return {**result, **more}

    def save(self) -> None:
        """Save the map as it is."""
        _save(self.mapping, self.out())


def _prepare(arguments: Namespace, node: Any, stack: ExitStack) -> tuple[Mapping, Options]:
    """Return the map and the options, with all kernels compiled."""
    from stereovox.ros.mapping import Mapping
    from stereovox.ros.options import SLAM
    from stereovox.ros.poses.corrections import check_corrections
    from stereovox.ros.services import check_continuable
    from stereovox.runs.pose_choice import NOT_COMPARED, TRACK, uncompared
    from stereovox.runs.warm_up import warm_up

    config, options = _settings(arguments, node)
    if config.dimensions == 2 and options.localised and not arguments.load:
        trusting = uncompared(config)
        why = "SLAM and localisation correct the robot's pose by more than a cell at times"
        if trusting is not config:
            node.get_logger().info(NOT_COMPARED.format(why=why))
        config = trusting
    options.check_sources()
    check_corrections(options, config)
    _reserve(options.out, config.dimensions, stack)
    if options.slam_out:
        _reserve(options.slam_out, 2, stack)
    say_about_compiling()
    warm_up(config, options.poses == TRACK, options.localised, bool(options.cloud or options.scan))
    tiles = Path(options.out).parent / f".{Path(options.out).name}-tiles" if options.out else None
    mapping = Mapping(config, options.heights, tiles, node.get_logger().warning)
    stack.callback(mapping.close)
    if arguments.load:
        check_continuable(arguments.load, options.poses not in (TRACK, SLAM))
        mapping.load(arguments.load)
    return mapping, options


def _write_nav2(arguments: Namespace) -> dict[str, Any]:
    from stereovox.ros.nav2 import write_nav2

    paths = write_nav2(arguments.write_nav2, arguments.nav2_params)
    say(f"written: {', '.join(str(path) for path in paths)}; start them with: ros2 launch {paths[1]}")
    return {"written": [str(path) for path in paths]}


def _map(run: _Run) -> dict[str, Any]:
    from stereovox.runs.recording import interrupt_between_steps

    say("listening; Ctrl-C ends")
    with interrupt_between_steps() as check:
        try:
            with suppress(KeyboardInterrupt):
                while True:
                    run.map_node.spin_once()
                    check()
                    run.step()
        except Exception:  # whatever failed, the map so far is saved
            run.save()
            raise
        return run.end()  # still under `check`: a second signal, as `timeout` sends it, must not interrupt this


def _print_ended(ended: dict[str, Any], slam_out: str) -> dict[str, Any]:
    """Save SLAM's map; print what localisation, SLAM and the comparison found, and return it for JSON."""
    from stereovox.formats.map_server import write_map_server

    grid = ended.pop("slam_map", None)
    if "localisation" in ended:
        refused = sum(ended["localisation"]["refused"].values())
        say(f"localised by {ended['localisation']['scans']} scans, {refused} refused")
    if "slam" in ended:
        say(f"SLAM: {ended['slam']['closures']} loops closed")
    if grid is not None and slam_out:
        write_map_server(grid, slam_out)
        say(f"SLAM's map is saved in {slam_out}")
    if "error" in ended:
        eq7, coverage, contradiction = ended["error"].values()
        parts = f"coverage {coverage:.1f}, contradiction {contradiction:.1f}"
        say(f"error against the reference (Eq 7): {eq7:.1f} %, {parts}")
    return ended


def _checkpoint(checkpoints: Checkpoints, frames: int, node: Any) -> None:
    """Save the map if a checkpoint is due; a full disk is logged and does not stop the robot."""
    try:
        if frames:
            checkpoints.after(frames)
    except MapFileError as error:
        node.get_logger().error(str(error), throttle_duration_sec=10.0)


def _print_result(map_node: MapNode, mapping: Mapping, out: str, reports: deque[UpdateReport]) -> dict[str, Any]:
    from stereovox.evaluate.summary import mostly_lost, percentiles

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
    came = result["frames"] + result["frames_refused"] + sum(result["dropped"].values())
    if doubts := mostly_lost(result["frames"], came, "frames"):
        result["doubts"] = doubts
    say(f"{result['frames']} frames mapped, {result['frames_refused']} refused, {sum(result['dropped'].values())} late")
    for reason, number in result["refused"].items():
        example = next((f", last: {one.detail}" for one in reversed(reports) if one.refused == reason), "")
        say(f"  {number} x {reason}{example}")
    if mapped:
        say(f"a frame: {milliseconds(result['frame_ms'])}")
    if _save(mapping, out, but_few(result)):
        result["out"] = out
    elif out:
        say("no frame could be used: no map is written")
    return result


def _save(mapping: Mapping, out: str, few: str = "") -> bool:
    """Save the map if it holds a frame and `out` is given; return whether it was saved. few: as of `but_few`."""
    if not (out and mapping.history.frames):
        return False
    mapping.save(out)
    say(f"saved in {out}{few}")
    return True


def _settings(arguments: Namespace, node: Any) -> tuple[Config, Options]:
    """Return the settings of the map and the options of the node; the command line overrides parameters."""
    from stereovox.config import load_config
    from stereovox.ros.options import LISTS, PREFIX, Options, given_parameters, with_parameters

    given, settings = given_parameters(node), overrides(arguments)
    options = {name: settings.pop(name) for name in [*settings] if name.startswith(PREFIX)}
    profile = arguments.profile or given.settings.pop("profile", "default")
    given.settings.pop("profile", None)
    config = load_config(profile, **{**given.settings, **settings})
    corrections = "corrected_path", "path_frame", "correct_jumps"
    localisation = "lidar", "start", "slam_out", "reference"
    names = *LISTS, "poses", *localisation, "world_frame", "base_frame", *corrections, "out"
    named = {name: getattr(arguments, name) for name in names}
    given.options.update({name.removeprefix(PREFIX): value for name, value in options.items()})
    return config, with_parameters(Options(), {**given.options, **{name: one for name, one in named.items() if one}})


def _reserve(out: str, dimensions: int, stack: ExitStack) -> None:
    """Check that the map can be saved, and keep others from writing there."""
    from stereovox.maps.files.lock import only_writer_in, only_writer_of_floor
    from stereovox.maps.files.store import check_target, sweep

    if out and dimensions == 2:
        stack.enter_context(only_writer_of_floor(check_file(out, FLOOR_ENDINGS)))
    elif out:
        check_in_space(out)
        check_target(Path(out))
        stack.enter_context(only_writer_in(Path(out)))
        sweep(Path(out))
