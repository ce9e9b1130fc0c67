# SPDX-License-Identifier: Apache-2.0
"""Measure the depth errors of a camera from recordings of a flat wall, and write a camera file that corrects them.

Record a flat, textured wall that fills the view with a still camera, about 30 frames; measure the distance from the
camera to the wall along the optical axis. Two or more distances show how the error grows. Put the camera file into the
folder of a recording, or use it with: stereovox map SOURCE --camera FILE.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from stereovox.cli.recordings import add_recordings, check_distances, check_outputs, read_walls
from stereovox.cli.terminal import say

if TYPE_CHECKING:
    from stereovox.calibrate.wall import WallCalibration

EXAMPLES = """stereovox calibrate wall near far --distance 1.4 --distance 3 --out camera.toml --report wall-report
stereovox calibrate wall recordings/wall --distance 1.4 --out camera.toml"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help="camera file to write, for example camera.toml")
    parser.add_argument(
        "--model",
        default="auto",
        metavar="NAME",
        help="scale, disparity, scale+disparity, thesis (Chien 2020), or auto (default): the one that predicts best",
    )
    parser.add_argument(
        "--square",
        action="store_true",
        help="the walls are exactly perpendicular to the optical axis; otherwise their tilt is estimated",
    )
    parser.add_argument(
        "--check", action="append", default=[], metavar="RECORDING", help="a wall to test the result on; repeatable"
    )
    parser.add_argument(
        "--check-distance", action="append", type=float, default=[], metavar="M", help="its distance, once for each"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Calibrate, write the camera file and print how flat the walls are before and after."""
    from stereovox.calibrate.wall import calibrate_wall, check_model

    check_model(arguments.model)
    check_distances(arguments.recordings, arguments.distance)
    check_distances(arguments.check, arguments.check_distance, "--check-distance")
    check_outputs(arguments.out, arguments.report)
    walls = read_walls(arguments.recordings, arguments.distance, arguments.frames, raw=True)
    check = read_walls(arguments.check, arguments.check_distance, arguments.frames, raw=True)
    found = calibrate_wall(walls, arguments.model, arguments.square, check)
    _write(arguments.out, found)
    _print_result(found, arguments.out)
    result = {**found.as_dict(), "out": arguments.out}
    if arguments.report:
        from stereovox.view.report.calibration import write_wall_report

        result["report"] = str(write_wall_report(arguments.report, found, arguments.out))
        say(f"report: {result['report']}")
    return result


def _write(out: str, found: WallCalibration) -> None:
    from stereovox.files.safe_io import replacing
    from stereovox.sources.calibration.camera_file import camera_text

    fitted = [wall.as_dict() for wall in found.walls if wall.fitted]
    provenance = {
        "recordings": [wall["name"] for wall in fitted],
        "distances_m": [round(wall["distance_m"], 4) for wall in fitted],
        "before_percent": [round(wall["before_percent"], 3) for wall in fitted],
        "after_percent": [round(wall["after_percent"], 3) for wall in fitted],
        "model_chosen": found.why,
    }
    with replacing(out) as file:
        file.write(camera_text(found.camera, provenance, ("written by stereovox calibrate wall",)).encode())


def _print_result(found: WallCalibration, out: str) -> None:
    for note in found.notes:
        say(f"note: {note}")
    say(f"model {found.correction.model}: {found.why}")
    for wall in (wall.as_dict() for wall in found.walls):
        kind = "" if wall["fitted"] else ", not fitted"
        say(
            f"  wall at {wall['distance_m']:.2f} m, leaning {wall['tilt_deg']:.1f} deg{kind}: off by "
            f"{wall['before_percent']:.2f} % RMS of the depth, {wall['after_percent']:.2f} % when corrected"
        )
    say(f"saved {out}; use it with: stereovox map SOURCE --out MAP --camera {out}")
