# SPDX-License-Identifier: Apache-2.0
"""Drive a simulated robot through a building and record it as a ROS bag.

Lidar, Kinect, odometry and tf as a robot would record them; .bag is ROS 1, .mcap and .db3 are ROS 2.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.recordings import open_noting
from stereovox.cli.terminal import command_line, progress_bar, say, size
from stereovox.files.safe_io import check_file

EXAMPLES = """stereovox simulate sim:floor --out floor.bag
stereovox simulate 'sim:floor?plan=testbed&seconds=60' --out testbed.mcap"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="ROBOT", help="sim:floor, with options: 'sim:floor?plan=testbed&seed=1'")
    parser.add_argument("--out", required=True, metavar="BAG", help="file to write: .bag, .mcap or .db3")


def run(arguments: Namespace) -> dict[str, Any]:
    """Write the bag and print what it contains."""
    from stereovox.simulate.floors.floor import write_bag

    out = check_file(arguments.out, (".bag", ".mcap", ".db3"))
    robot = open_noting(arguments.source)
    with progress_bar() as bar:
        task = bar.add_task("driving", note="")
        write_bag(robot, out, lambda done, total: bar.update(task, completed=done, total=total))
    written = {"file": str(out), "scans": len(robot.scans), "frames": len(robot.frames), "bytes": out.stat().st_size}
    say(f"{written['scans']} scans and {written['frames']} depth images saved in {out} ({size(written['bytes'])})")
    say(f"make the reference map from it with: {command_line('slam', out, '--out', 'reference.yaml')}")
    return written
