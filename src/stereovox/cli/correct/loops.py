# SPDX-License-Identifier: Apache-2.0
"""Close the loops of a map: find revisited places, and correct the camera's path so that they coincide.

The map must have kept its frames (map --set map.keep_frames=true; map --close-loops does both). Places are compared by
their surfaces; a match is accepted if no other place within reach matches, the poses allow it and another match agrees.
The result is bit for bit the map of a new run with the corrected poses.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import check_new, check_there, describe_saved, name_beside
from stereovox.cli.options import add_settings, overrides
from stereovox.cli.terminal import progress_of_steps, say, say_about_compiling

if TYPE_CHECKING:
    from stereovox.correct.close_loops import ClosedMap, LoopClosure

EXAMPLES = """stereovox loops kitchen.svox
stereovox loops kitchen.svox --json"""
SHOWN, FAR_M = 5, 1.5
"""Most rejected places that are listed; and error of the poses from which on a note warns of a confusion."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map that kept its frames")
    parser.add_argument("--out", metavar="OUT", help="folder of the new map (default: NAME-closed.svox here)")
    parser.add_argument("--trajectory", metavar="FILE", help="write the corrected poses: .tum or .txt")
    about = "the path before and after, the loops, and the map where poses were most off: .png, .pdf or .svg"
    parser.add_argument("--picture", metavar="FILE", help=about)
    parser.add_argument(
        "--positions", metavar="FILE",
        help="positions of the camera that do not drift, as from GNSS: lines as --trajectory writes, in metres, or a "
        "bag with sensor_msgs/NavSatFix",
    )  # fmt: skip
    parser.add_argument("--positions-sigma", type=float, default=1.0, metavar="M", help="their standard deviation (1)")
    about = "a second odometry, as from wheels: poses of the camera, lines as --trajectory writes"
    parser.add_argument("--odometry", metavar="FILE", help=about)
    add_settings(parser, "loops.drift=0.05")


def run(arguments: Namespace) -> dict[str, Any]:
    """Close the loops and print the result."""
    from stereovox.correct.close_loops import close_loops
    from stereovox.files.safe_io import check_file
    from stereovox.sources.poses.trajectory import TRAJECTORY_ENDINGS
    from stereovox.view.figures import ENDINGS

    out = arguments.out or name_beside(arguments.map, "closed")
    check_new(out, arguments.map)
    check_there(arguments.map)
    for file, endings in ((arguments.picture, ENDINGS), (arguments.trajectory, TRAJECTORY_ENDINGS)):
        if file:
            check_file(file, endings)
    say_about_compiling()
    with progress_of_steps("searching for loops") as progress:
        done = close_loops(
            arguments.map, out, positions=arguments.positions, positions_sigma=arguments.positions_sigma,
            odometry=arguments.odometry, progress=progress, **overrides(arguments),
        )  # fmt: skip
    say_closure(done.closure)
    if arguments.trajectory:
        done.closure.save(arguments.trajectory)
        if len(set(done.closure.sensors)) > 1:
            say(f"note: {arguments.trajectory} holds the poses of '{done.closure.sensors[0]}' (remap --sensor)")
    if arguments.picture:
        _picture(done, arguments)
    return {**describe_saved(done.map, out), **done.closure.summary()}


def _picture(done: ClosedMap, arguments: Namespace) -> None:
    """Draw the map before and after."""
    from stereovox.maps import load_map
    from stereovox.view.loops import loops_picture

    loops_picture(done.closure, done.map, arguments.picture, load_map(arguments.map))
    say(f"saved {arguments.picture}")


def say_closure(closure: LoopClosure) -> None:
    """Print the loops that were found, and what they changed."""
    summary = closure.summary()
    if closure.loops:
        off = summary["off_m"]["max"]
        say(f"{len(closure.loops)} loops closed, where the poses were off by up to {off:.2f} m")
        if off > FAR_M:
            say("note: similar places no farther apart than that may have been confused; check the map")
    else:
        say(f"no loop was found: none of the {len(closure.places)} places was certainly seen twice")
    if closure.odometry is not None:
        used, other = closure.odometry.used, closure.odometry.contradicted
        say(f"the second odometry was used in {used} steps between places; in {other} it contradicts the map's poses")
    if closure.positions is not None:
        used, other = closure.positions.used, closure.positions.contradicted
        say(f"{used} places of the path agree with the positions, {other} do not")
    moved = summary["moved_m"]
    say(f"frames moved by {moved['median']:.3f} m (median), at most {moved['max']:.3f} m")
    if not closure.report.all_frames:
        say(f"note: only {len(closure.stamps_ns)} frames were kept (map.frames_budget); the map is made of these")
    if closure.refused:
        say(f"{len(closure.refused)} places look the same but were rejected as loops:")
    for one in summary["loops_refused"][:SHOWN]:
        say(f"  {one['at']} like {one['like']}: {one['why']}")
    if len(closure.refused) > SHOWN:
        say(f"  and {len(closure.refused) - SHOWN} more (--json)")
