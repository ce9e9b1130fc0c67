# SPDX-License-Identifier: Apache-2.0
"""Map a recording, a simulation or a live camera.

SOURCE is a folder or file with depth images or stereo pairs and poses, recognised by its content (`stereovox info`
describes it, docs/recordings.md lists the formats), the simulation sim:room, or a connected camera, realsense:. Unless
an option or profile gives them, the up direction, the range and the cell size follow from a survey of the recording.
Under a 2-D profile (ist2019) it is the recording of a ground robot, as for `stereovox grid`.
"""

from __future__ import annotations

import shlex
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.correct.loops import say_closure
from stereovox.cli.look.live_page import page_of, rerun_of
from stereovox.cli.options import add_checkpoint, add_settings, add_usual, check_ending, options_of
from stereovox.cli.terminal import (
    but_few,
    cells_line,
    command_line,
    first_included,
    progress_of,
    say,
    say_about_compiling,
    say_lost,
    say_refusals,
    size,
    thousands,
)
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config, WindowConfig
    from stereovox.maps import VoxelMap
    from stereovox.runs.recording import MapResult

PORT = 8080
EXAMPLES = """stereovox map recordings/kitchen --out kitchen.svox
stereovox map drive.bag --poses track --voxel-size 0.2 --max-range 20 --out drive.svox"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="recorded folder or file, sim:room etc., or realsense:")
    parser.add_argument(
        "--out", metavar="MAP", help="folder of the map to write (default: NAME.svox here, unless there is one)"
    )
    parser.add_argument(
        "--profile", metavar="P", help="profile name or TOML file (default; with --resume the map's own settings)"
    )
    add_usual(parser, "voxel-size")
    parser.add_argument("--integrator", metavar="NAME", help="projective (default), ray or line")
    add_usual(parser, "max-range", "frames", "camera")
    parser.add_argument(
        "--poses",
        metavar="WHICH",
        help="given: those of the recording (default, if there are any); track: visual odometry from the images "
        "alone; both: given ones, corrected by the images",
    )
    parser.add_argument(
        "--close-loops", action="store_true",
        help="keep the frames, and at the end correct the camera's path so that revisited places coincide",
    )  # fmt: skip
    parser.add_argument(
        "--level", action="store_true", help="turn the recording's world so that z points up and layers are level"
    )
    add_usual(parser, "threads")
    parser.add_argument(
        "--device", metavar="NAME", help="cpu (default), or cuda: an NVIDIA graphics card, if there is one"
    )
    add_settings(parser, "sensor.model=andert")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue the map at --out; frames of SOURCE that it has already seen are skipped",
    )
    add_checkpoint(parser)
    parser.add_argument(
        "--view",
        type=int,
        nargs="?",
        const=PORT,
        metavar="PORT",
        help=f"show the map in a browser while it grows, and afterwards until Ctrl-C ({PORT}; 0: any free port)",
    )
    parser.add_argument(
        "--rerun", metavar="FILE.rrd", help="also write depth images, camera and growing map for the Rerun viewer"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Map the source, save the map and print a summary."""
    floor = _is_floor_map(arguments)
    if arguments.out is None:
        arguments.out = _usual_out(arguments, ".yaml" if floor else ".svox")
    if floor:
        return _grid(arguments)
    check_ending("--rerun", arguments.rerun, ".rrd")
    return _map(arguments, Path(arguments.out))


def _usual_out(arguments: Namespace, ending: str) -> str:
    """Return the default name of the map; raises StereovoxError if that would replace something."""
    from stereovox.descriptions.files import map_name

    out = map_name(arguments.source, ending)
    if Path(out).exists() and not arguments.resume:
        raise StereovoxError(f"{out}: already exists; replace it with --out {shlex.quote(out)}, or give another name")
    return out


def _map(arguments: Namespace, out: Path) -> dict[str, Any]:
    from stereovox.runs.recording import MapRun, RecordingOptions

    run = MapRun(arguments.source, out, **options_of(RecordingOptions, arguments))
    with run, page_of(run.mapper, out.stem, arguments.view) as page:
        say_about_compiling()
        with rerun_of(run.mapper, arguments.rerun) as recorded, progress_of(run.remaining, "mapping") as bar:
            mapped = run.finish((page, recorded, bar), bar.step)
            recorded.finish()
        result = mapped.summary() | ({"dropped": mapped.dropped} if run.source.length is None else {})
        page.finish()
        _print_result(result, mapped, out, run.mapper.config)
        page.stay()
    return result


def _is_floor_map(arguments: Namespace) -> bool:
    """Return whether the settings are for the 2-D map of a ground robot, as in profile ist2019."""
    from stereovox.cli.recordings import settings_of

    return settings_of(arguments).dimensions == 2


def _grid(arguments: Namespace) -> dict[str, Any]:
    """Run `stereovox grid`, which has more options."""
    from stereovox.cli.ask.grid import run_floor

    for option in ("camera", "close_loops", "device", "integrator", "level", "poses", "threads", "view", "rerun"):
        if getattr(arguments, option) not in (None, False):
            raise StereovoxError(f"--{option}: does not apply to a floor map; leave it out")
    return run_floor(arguments)


def _print_result(result: dict[str, Any], mapped: MapResult[VoxelMap], out: Path, config: Config) -> None:
    from stereovox.descriptions.files import picture_name
    from stereovox.maps.record.health import FULL

    say_refusals(result, mapped.reports, "frames")
    say(_poses_line(mapped))
    say_lost(mapped.lost)
    if mapped.loops is not None:
        say_closure(mapped.loops)
    if mapped.imu:
        say(f"note: {mapped.imu}")
    if result.get("dropped"):
        say(f"  {result['dropped']} more were dropped because the map was busy; see --set deadline_ms=")
    if reduced := [f"{number} {quality}" for quality, number in result["quality"].items() if quality != FULL]:
        say(f"reduced quality to meet the deadline: {', '.join(reduced)}")
    if result["match_ms"]["max"]:  # stereo pairs
        say(f"per pair: {result['match_ms']['median']:.3g} ms to match it (median)")
    depth, cells = result["depth_ms"]["median"], result["integrate_ms"]["median"]
    times = f"{depth:.2g} ms to prepare it, {cells:.2g} ms to map it (medians)"
    say(f"per frame: {times}{first_included(result)}")
    say(cells_line(result, config.voxel_size))
    if (kept := mapped.map.kept_frames) is not None:
        say(f"keeps {len(kept)} of its frames, {size(kept.bytes)}: poses can be corrected (remap)")
    if not result["occupied"]:
        say(f"note: {_why_empty(result, config.window)}")
    say(f"saved in {out}{but_few(result)}; look at it with: {command_line('picture', out, picture_name(str(out)))}")


def _poses_line(mapped: MapResult[VoxelMap]) -> str:
    """Return a line about the poses that were used, and the number of tracked frames."""
    if mapped.poses == "given":
        return "poses: from the recording"
    lost, how = sum(map(len, mapped.lost)), "tracked" if mapped.poses == "track" else "corrected by the images"
    believed = f"; {mapped.believed} uncorrected, since nothing known was in view" if mapped.believed else ""
    return f"poses: {how}, {len(mapped.reports) - lost} of {len(mapped.reports)} frames{believed}"


def _why_empty(result: dict[str, Any], window: WindowConfig) -> str:
    """Return the likely reason for a map without an occupied cell."""
    if window.centre is not None and not result["free"] + result["tentative"]:
        return "no cell is known; the camera was never in the box of window.centre and window.size"
    if result["tentative"]:
        tentative = thousands(result["tentative"])
        causes = "is --max-range large enough, map.false_alarm too large?"
        return f"no cell is occupied, but {tentative} are tentative; {causes}"
    return "no cell is occupied; is --max-range large enough?"
