# SPDX-License-Identifier: Apache-2.0
"""Find the poses of a camera from its own depth images or stereo pairs.

SOURCE is as for `map`, with or without poses; its own poses serve only for comparison. The poses are the same as with
`map --poses track`. Frames in which tracking was lost have no pose; if there are any, the exit status is 3.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_settings, add_usual, check_ending, options_of
from stereovox.cli.terminal import command_line, progress_of_steps, say, say_about_compiling, say_lost

if TYPE_CHECKING:
    from stereovox.evaluate.trajectory_score import TrajectoryScore

ALIKE = ("profile", "max_range", "frames", "camera")
"""Options that `map` has too, and that affect poses."""
EXAMPLES = """stereovox track recordings/kitchen --out kitchen.tum
stereovox track recordings/kitchen --frames :300 --out start.tum"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="recorded folder or file, sim:room etc., or realsense:")
    parser.add_argument(
        "--out", required=True, metavar="FILE", help="poses to write: .tum or .txt, lines 'stamp tx ty tz qx qy qz qw'"
    )
    about = "the path from above, gaps in tracking, and errors if the recording has poses"
    parser.add_argument("--picture", metavar="FILE.png", help=about)
    add_usual(parser, "profile", "max-range", "frames", "camera")
    add_settings(parser, "noise.subpixel=0.1")


def run(arguments: Namespace) -> dict[str, Any]:
    """Track the source, write its poses and print a summary."""
    from stereovox.files.safe_io import check_file
    from stereovox.runs.trajectory import TrackOptions, track_recording

    check_ending("--picture", arguments.picture, ".png")
    if arguments.picture:
        check_file(arguments.picture, (".png",))
    say_about_compiling()
    with progress_of_steps("tracking") as progress:
        options = options_of(TrackOptions, arguments)
        found = track_recording(arguments.source, arguments.out, progress=progress, **options)
    result = found.summary()
    median = f"{result['frame_ms']['median']:.3g} ms per frame (median)"
    say(f"{result['tracked']} of {result['frames']} frames tracked over {result['length_m']:.2f} m, {median}")
    say_lost(found.lost)
    if found.score is not None:
        say(_score_line(found.score))
    if arguments.picture:
        found.picture(arguments.picture)
        say(f"saved {arguments.picture}")
    say(f"saved in {arguments.out}; make a map with these poses: {_map_line(arguments)}")
    return result


def _map_line(arguments: Namespace) -> str:
    """Return the command that makes a map with the same poses, so with the same options."""
    given = [(f"--{name.replace('_', '-')}", getattr(arguments, name)) for name in ALIKE]
    given += [("--set", setting) for setting in arguments.settings]
    words = [word for option in given if option[1] is not None for word in option]
    return command_line("map", arguments.source, "--poses", "track", *words)


def _score_line(score: TrajectoryScore) -> str:
    drift = "" if score.drift_percent is None else f"; the end is off by {score.drift_percent:.2g} % of the length"
    off = f"positions are off by {100 * score.position_m.rmse:.2g} cm (RMS)"
    return f"aligned with the recording's own poses, {off}{drift}"
