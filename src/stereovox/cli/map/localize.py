# SPDX-License-Identifier: Apache-2.0
"""Localise a robot in a map from its lidar and odometry (adaptive Monte Carlo localisation).

MAP is a map_server file. Without --start the robot may be anywhere in it.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.maps import open_grid
from stereovox.cli.recordings import add_robot, open_noting, print_trajectory_error, settings_of
from stereovox.cli.terminal import but_few, progress_of_steps, say, say_about_compiling
from stereovox.files.safe_io import check_file

if TYPE_CHECKING:
    from stereovox.localize.track import Track

TEXT, BAGS = (".tum", ".txt"), (".bag", ".mcap", ".db3")
EXAMPLES = """stereovox localize floor.bag reference.yaml --out robot.tum
stereovox localize floor.bag reference.yaml --start 1,2,90 --out path.tum --json"""


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
    """Declare --start."""
    parser.add_argument("--start", metavar="X,Y,DEG", help="first pose of the robot in the map: metres and degrees")


def run(arguments: Namespace) -> dict[str, Any]:
    """Localise, save the trajectory and print its end."""
    from stereovox.evaluate.metrics import mostly_lost
    from stereovox.localize.robot_track import check_start, fit_of, localise_robot, parse_start, refused_line

    out, config = check_file(arguments.out, (*TEXT, *BAGS)), settings_of(arguments)
    start, grid = parse_start(arguments.start or ""), open_grid(arguments.map)
    check_start(start, grid)
    robot = open_noting(arguments.source)
    say_about_compiling()
    with progress_of_steps("localising") as progress:
        track = localise_robot(robot, grid, config, start, progress)
    _save(track, out)
    fit, fit_line = fit_of(robot, grid, track)
    for line in filter(None, (refused_line(track.refused, track.first_refusal), fit_line)):
        say(line)
    x, y, yaw = track.pose_map_base[-1]
    count, lost = len(track.stamps_ns), sum(track.refused.values())
    doubts = mostly_lost(count, count + lost, "scans", "have poses")
    say(f"last pose of the robot: x {x:.2f} m, y {y:.2f} m, {np.degrees(yaw):.0f} degrees")
    refused = {"scans_refused": lost, "refused": dict(track.refused), **({"doubts": doubts} if doubts else {})}
    say(f"{count} poses saved in {out}{but_few(refused)}")
    found = {"poses": count, "last": [x, y, float(np.degrees(yaw))], "fit": fit}
    return {**found, **refused, **print_trajectory_error(track, robot)}


def _save(track: Track, out: Path) -> None:
    """Write the trajectory as text, or to a bag as ROS's amcl publishes it: /amcl_pose, and map -> odom on /tf."""
    if out.suffix.lower() in TEXT:
        return track.save(out)
    from stereovox.geometry import se2
    from stereovox.sources.bags.writer import BagWriter

    with BagWriter(out) as bag:
        for stamp_ns, base, odom in zip(
            track.stamps_ns.tolist(), track.pose_map_base, track.pose_map_odom, strict=True
        ):
            bag.pose(stamp_ns, base)
            bag.transform(stamp_ns, "map", "odom", se2.lifted(odom))
