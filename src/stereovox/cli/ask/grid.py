# SPDX-License-Identifier: Apache-2.0
"""Map a ground robot's depth images or lidar scans to a 2-D floor map (map_server files).

Poses come from SLAM (--poses slam), localisation in a map (--poses MAP.yaml) or the wheels (--poses odometry). The
default is slam if there is a lidar.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.map.localize import add_start
from stereovox.cli.options import add_checkpoint, add_usual, options_of
from stereovox.cli.recordings import add_robot, picture_line, settings_of
from stereovox.cli.terminal import (
    but_few,
    cells_line,
    first_included,
    milliseconds,
    progress_of,
    progress_of_steps,
    say,
    say_about_compiling,
    say_refusals,
)

if TYPE_CHECKING:
    from stereovox.frame import UpdateReport

EXAMPLES = """stereovox grid floor.bag --poses reference.yaml --out kinect.yaml
stereovox grid sim:floor --out floor.yaml"""
MODES = ("trinary", "scale", "raw")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument("--out", required=True, metavar="MAP", help="map_server files to write, for example floor.yaml")
    parser.add_argument("--poses", metavar="HOW", help="slam, odometry, or a MAP.yaml to localise in")
    parser.add_argument(
        "--use", choices=("depth", "lidar", "both"), help="readings to map (depth images if there are any)"
    )
    parser.add_argument("--frames", metavar="A:B:S", help="only these readings, as a Python slice")
    add_usual(parser, "voxel-size")
    parser.add_argument("--max-range", type=float, metavar="M", help="largest range in metres that is used")
    parser.add_argument("--mode", choices=MODES, default="trinary", help="how the files store probabilities (trinary)")
    parser.add_argument(
        "--resume", metavar="MAP", help="continue this map; without --poses the robot is localised in it"
    )
    add_start(parser)
    add_checkpoint(parser)


def run(arguments: Namespace) -> dict[str, Any]:
    """Map the recording, save the map and print a summary."""
    from stereovox.localize.robot_track import parse_start

    arguments.start = parse_start(arguments.start or "")
    return run_floor(arguments)


def run_floor(arguments: Namespace) -> dict[str, Any]:
    """Make a floor map with progress bars and print a summary."""
    from stereovox.runs.floor import FloorOptions, FloorRun

    options = options_of(FloorOptions, arguments) | {"profile": settings_of(arguments)}
    with FloorRun(arguments.source, arguments.out, **options) as run:
        say_about_compiling()
        with progress_of_steps("finding the trajectory") as progress:
            run.find_track(progress)
        with progress_of(run.remaining, "mapping") as bar:
            mapped = run.finish([bar])
    result = mapped.summary()
    _print_result(result, mapped.reports, mapped.out)
    return result


def _print_result(result: dict[str, Any], reports: list[UpdateReport], out: Path) -> None:
    say_refusals(result, reports, "readings")
    times = f"scan {milliseconds(result['depth_ms'])}; map {milliseconds(result['integrate_ms'])}"
    say(f"per reading: {times}{first_included(result)}")
    say(cells_line(result))
    say(f"saved in {out.with_suffix('.yaml')}{but_few(result)}; look at it with: {picture_line(out)}")
    if not result["occupied"] and not result["free"]:
        say("note: no cell is known yet, since a single reading is too little evidence; map more")
