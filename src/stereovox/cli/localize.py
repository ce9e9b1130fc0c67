# SPDX-License-Identifier: Apache-2.0
"""Find out where a robot was in a map, from its lidar and odometry (adaptive Monte Carlo localisation).

MAP is what map_server reads. Without --start the robot may be anywhere in it.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.robots import add_robot, check_file, opened, say_refused, settings_of, way_error
from stereovox.cli.terminal import progress_bar, say, say_about_compiling
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.localize.track import Track
    from stereovox.maps.occupancy import OccupancyGrid
    from stereovox.sources.robot import Robot

TEXT, BAGS = (".tum", ".txt"), (".bag", ".mcap", ".db3")
DOUBTFUL = 0.6
"""Share of beams that fit the map below which the way may be wrong."""
EXAMPLE = "stereovox localize floor.bag reference.yaml --out way.tum"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument("map", metavar="MAP", help="map to localise in: .yaml of map_server")
    parser.add_argument(
        "--out",
        required=True,
        metavar="FILE",
        help="poses to write: .tum (stamp tx ty tz qx qy qz qw), or .bag, .mcap, .db3 with /amcl_pose and map -> odom",
    )
    add_start(parser)


def add_start(parser: ArgumentParser) -> None:
    """Declare where the robot began."""
    parser.add_argument("--start", metavar="X,Y,DEG", help="where the robot stood first: metres and degrees")


def run(arguments: Namespace) -> dict[str, Any]:
    """Localise, save the way and tell where it ended."""
    from stereovox.products.map_server import read_map_server

    out, config = check_file(arguments.out, (*TEXT, *BAGS)), settings_of(arguments)
    start, grid = parse_start(arguments.start), read_map_server(arguments.map)
    check_start(start, grid)
    robot = opened(arguments.source)
    say_about_compiling()
    track = localised(robot, grid, config, start)
    _save(track, out)
    say_refused(track.refused, track.first_refusal)
    x, y, yaw = track.pose_map_base[-1]
    fit = say_fit(robot, grid, track)
    say(f"{len(track.stamps_ns)} poses saved in {out}")
    say(f"the robot ended at x {x:.2f} m, y {y:.2f} m, {np.degrees(yaw):.0f} degrees")
    refused = {"scans_refused": sum(track.refused.values()), "refused": dict(track.refused)}
    found = {"poses": len(track.stamps_ns), "last": [x, y, float(np.degrees(yaw))], "fit": fit}
    return {**found, **refused, **way_error(track, robot)}


def _save(track: Track, out: Path) -> None:
    """Write the way as text, or as ROS's amcl tells it: /amcl_pose, and map -> odom on /tf."""
    if out.suffix.lower() in TEXT:
        return track.save(out)
    from stereovox import planar
    from stereovox.sources.bag_writer import BagWriter

    with BagWriter(out) as bag:
        for stamp_ns, base, odom in zip(
            track.stamps_ns.tolist(), track.pose_map_base, track.pose_map_odom, strict=True
        ):
            bag.pose(stamp_ns, base)
            bag.transform(stamp_ns, "map", "odom", planar.lifted(odom))


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


def check_start(start: np.ndarray | None, grid: OccupancyGrid) -> None:
    """Raise StereovoxError for a start outside of the map."""
    if start is None:
        return
    row, column = grid.indices(start[None, :2])[0]
    rows, columns = grid.cells.shape
    if not (0 <= row < rows and 0 <= column < columns):
        (x0, y0), (x1, y1) = grid.centres([0, rows - 1], [0, columns - 1])
        given = f"--start {start[0]:g},{start[1]:g},{np.degrees(start[2]):g}"
        raise StereovoxError(f"{given}: lies outside of the map, from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) m")


def say_fit(robot: Robot, grid: OccupancyGrid, track: Track) -> float | None:
    """Say how well the scans fit the map along the way, and doubt it where they do not; return the share of beams."""
    from stereovox.localize.fit import NEAR, fit_share

    fit = fit_share(grid, robot.scans, track)
    if fit is not None:
        doubt = "; is it the right map, and the right start?" if fit < DOUBTFUL else ""
        say(f"{100 * fit:.0f} % of the beams end within {NEAR:g} m of an obstacle of the map{doubt}")
    return fit


def localised(robot: Robot, grid: OccupancyGrid, config: Config, start: np.ndarray | None) -> Track:
    """Return the robot's way through the map, with a progress bar."""
    from stereovox.localize.amcl import localise

    if not len(robot.scans):
        raise StereovoxError(f"{robot.name}: holds no lidar scans to localise with; give a bag with a LaserScan topic")
    with progress_bar() as bar:
        task = bar.add_task("localising", total=len(robot.scans), note="")
        return localise(grid, robot.scans, config, start, progress=lambda done: bar.update(task, completed=done))
