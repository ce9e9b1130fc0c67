# SPDX-License-Identifier: Apache-2.0
"""Give the frames of a map corrected poses, as after a loop closure, and save the map that they make.

The map must have kept its frames (map --set map.keep_frames=true). The result is bit for bit the map of a new run with
these poses. Frames between two that have a pose in the file move with these; all others keep their poses.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.maps import check_new, check_there, describe_saved, name_beside
from stereovox.cli.terminal import say, say_about_compiling

EXAMPLES = """stereovox remap kitchen.svox --poses corrected.tum
stereovox remap kitchen.svox --poses corrected.tum --out remapped.svox"""

FAR = 10.0
"""How many times the length of their path frames may move without a note."""
FAR_TURNED_DEG = 45.0
"""How far half of them may turn without a note."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map that kept its frames")
    parser.add_argument(
        "--poses", required=True, metavar="FILE",
        help="corrected poses of the camera's optical frame: lines 'stamp tx ty tz qx qy qz qw' (TUM)",
    )  # fmt: skip
    parser.add_argument("--out", metavar="OUT", help="folder of the new map (default: NAME-corrected.svox here)")
    parser.add_argument("--sensor", metavar="NAME", help="the sensor of the poses, if the map has several")


def run(arguments: Namespace) -> dict[str, Any]:
    """Correct the map and print a report."""
    from stereovox.correct.remap import remap

    out = arguments.out or name_beside(arguments.map, "corrected")
    check_new(out, arguments.map)
    check_there(arguments.map)
    say_about_compiling()
    done = remap(arguments.map, arguments.poses, out, sensor=arguments.sensor)
    report = done.report
    say(f"{done.posed} frames have a pose in {arguments.poses}, {done.between} moved with their neighbours")
    if done.outside:
        say(f"note: {done.outside} frames before the first or after the last of them keep their poses")
    if done.repeated:
        say(f"note: {done.repeated} lines of {arguments.poses} repeat an earlier stamp and are ignored")
    if done.beyond:
        say(f"note: {done.beyond} poses are from before the first frame or after the last, and were not used")
    if not report.all_frames:
        say(f"note: only {report.mapped} frames were kept (map.frames_budget); the map is made of these")
    (median, most), (turned_deg, most_turned_deg) = done.moved_m, done.turned_deg
    say(
        f"{report.moved} frames moved, by {median:.2f} m and {turned_deg:.1f} degrees (median), at most {most:.2f} m "
        f"and {most_turned_deg:.1f} degrees; {report.mapped} were mapped again, {report.blocks} blocks rebuilt"
    )
    if most > FAR * max(done.way_m, 1.0):
        say(
            f"note: that is far more than the {done.way_m:.1f} m of their path; poses must be in metres, in the map's "
            "world"
        )
    if turned_deg > FAR_TURNED_DEG:
        say(
            "note: that is a large rotation; poses must be of the optical frame (x right, y down, z forward), "
            "quaternions x y z w"
        )
    return {**describe_saved(done.map, out), **done.summary()}
