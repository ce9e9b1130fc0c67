# SPDX-License-Identifier: Apache-2.0
"""Find out where a robot was in a map, from its lidar and odometry (adaptive Monte Carlo localisation).

MAP is what map_server reads. Without --start the robot may be anywhere in it.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from math import radians
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.robots import add_robot, check_file, opened, settings_of
from stereovox.cli.terminal import progress_bar, say, say_about_compiling
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.localize.track import Track
    from stereovox.maps.occupancy import OccupancyGrid
    from stereovox.sources.robot import Robot

EXAMPLE = "stereovox localize floor.bag reference.yaml --out way.tum"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument("map", metavar="MAP", help="map to localise in: .yaml of map_server")
    parser.add_argument("--out", required=True, metavar="FILE.tum", help="poses to write: stamp tx ty tz qx qy qz qw")
    add_start(parser)


def add_start(parser: ArgumentParser) -> None:
    """Declare where the robot began."""
    parser.add_argument("--start", metavar="X,Y,DEG", help="where the robot stood first: metres and degrees")


def run(arguments: Namespace) -> dict[str, Any]:
    """Localise, save the way and tell where it ended."""
    from stereovox.products.map_server import read_map_server

    out, config = check_file(arguments.out, (".tum", ".txt")), settings_of(arguments)
    start, grid = parse_start(arguments.start), read_map_server(arguments.map)
    robot = opened(arguments.source)
    say_about_compiling()
    track = localised(robot, grid, config, start)
    track.save(out)
    x, y, yaw = track.pose_map_base[-1]
    say(f"{len(track.stamps_ns)} poses saved in {out}")
    say(f"the robot ended at x {x:.2f} m, y {y:.2f} m, {np.degrees(yaw):.0f} degrees")
    return {"poses": len(track.stamps_ns), "last": [x, y, float(np.degrees(yaw))], **_error(track, robot)}


def parse_start(text: str | None) -> np.ndarray | None:
    """Return x, y in metres and yaw in radians of `X,Y,DEG`; raises StereovoxError for anything else."""
    if text is None:
        return None
    try:
        x, y, degrees = (float(part) for part in text.split(","))
    except ValueError:
        raise StereovoxError(f"--start {text}: give X,Y,DEG, for example --start=1.5,-2,90") from None
    if not np.isfinite([x, y, degrees]).all():
        raise StereovoxError(f"--start {text}: give finite numbers")
    return np.array([x, y, radians(degrees)])


def localised(robot: Robot, grid: OccupancyGrid, config: Config, start: np.ndarray | None) -> Track:
    """Return the robot's way through the map, with a progress bar."""
    from stereovox.localize.amcl import localise

    if not len(robot.scans):
        raise StereovoxError(f"{robot.name}: holds no lidar scans to localise with; give a bag with a LaserScan topic")
    with progress_bar() as bar:
        task = bar.add_task("localising", total=len(robot.scans), note="")
        return localise(grid, robot.scans, config, start, progress=lambda done: bar.update(task, completed=done))


def _error(track: Track, robot: Robot) -> dict[str, Any]:
    if robot.truth is None:
        return {}
    from stereovox.evaluate.trajectory_error import trajectory_error

    error = trajectory_error(track, robot.truth)
    say(f"the way is off by {100 * error.position_rms_m:.1f} cm (RMS) and {error.yaw_rms_deg:.2f} degrees")
    return {"position_rms_m": error.position_rms_m, "yaw_rms_deg": error.yaw_rms_deg}
