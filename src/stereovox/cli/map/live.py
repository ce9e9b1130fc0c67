# SPDX-License-Identifier: Apache-2.0
"""Map live cameras, with poses as they arrive.

SOURCE is a camera (realsense: or realsense:SERIAL), a file of several (live.toml), or a recording or simulation, which
is played at its own pace like a camera. Poses come from visual odometry, a T265, or another program that sends lines
'stamp tx ty tz qx qy qz qw'. Ctrl-C ends and saves.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_checkpoint, add_settings, add_usual, check_ending, heights_of, options_of
from stereovox.cli.terminal import (
    but_few,
    cells_line,
    command_line,
    milliseconds,
    progress_of,
    say,
    say_about_compiling,
    say_refusals,
)
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.live.rig import LiveCamera
    from stereovox.live.run import LiveResult
    from stereovox.mavlink.sectors import SectorRules

EXAMPLES = """stereovox live realsense: --poses udp://:5005 --out room.svox --view
stereovox live sim:room --out room.svox --mavlink udpout:127.0.0.1:14550"""
PORT = 8080
WAIT_S = 0.3
"""Copy of `live.stream.WAIT_S`, so that `--help` need not import it."""

POSE_RATE_HZ = 30.0
RULES: dict[str, dict[str, Any]] = {
    "half_height": {
        "type": float,
        "metavar": "M",
        "help": "--mavlink: height above and below the body that counts (0.3)",
    },
    "own_radius": {"type": float, "metavar": "M", "help": "--mavlink: unknown cells so near are the vehicle (0.5)"},
    "max_distance": {"type": float, "metavar": "M", "help": "--mavlink: how far obstacles are looked for (5)"},
    "unknown": {"choices": ("obstacle", "unmeasured"), "help": "--mavlink: what unknown space counts as (obstacle)"},
}
"""Options that are fields of `SectorRules`."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="realsense:, a live.toml, or a recording or simulation")
    parser.add_argument("--out", required=True, metavar="MAP", help="folder of the map to write")
    about = "track: by the first camera's images; given: those of a recording; t265; udp://[HOST]:PORT or"
    parser.add_argument(
        "--poses", metavar="FROM",
        help=f"{about} tcp://HOST:PORT: lines, axes behind ?axes=; mavlink:URL: an autopilot's (given, else track)",
    )  # fmt: skip
    parser.add_argument(
        "--mount", metavar="X,Y,Z,ROLL,PITCH,YAW",
        help="pose of the camera on the body (x forward, y left, z up): metres and degrees (at its origin, ahead)",
    )  # fmt: skip
    parser.add_argument(
        "--clock-offset", type=float, metavar="S", help="image stamp minus the stamp of a pose at that moment (0)"
    )
    parser.add_argument(
        "--wait",
        type=float,
        default=WAIT_S,
        metavar="S",
        dest="wait_s",
        help=f"how long an image waits for its pose ({WAIT_S:g})",
    )
    parser.add_argument("--seconds", type=float, metavar="S", help="how long to map (until Ctrl-C)")
    parser.add_argument("--grid", metavar="FILE.yaml", help="2-D map (map_server) to keep up to date")
    parser.add_argument(
        "--heights", metavar="LO:HI", help="metres above the floor that a robot occupies (scan.heights)"
    )
    parser.add_argument("--sphere", metavar="FILE.png", help="picture of the distances in all directions, at the end")
    parser.add_argument("--record", metavar="FILE.mcap", help="also record depth images and poses (.bag, .db3)")
    parser.add_argument(
        "--view", type=int, nargs="?", const=PORT, metavar="PORT",
        help=f"show the map in a browser while it grows ({PORT}; 0: any free port)",
    )  # fmt: skip
    about = "tell an autopilot at this address (udpout:127.0.0.1:14540) of obstacles: OBSTACLE_DISTANCE"
    parser.add_argument("--mavlink", metavar="URL", help=about)
    parser.add_argument(
        "--send-pose", nargs="?", const="odometry", choices=("odometry", "vision"),
        help="send the body's pose there, too: ODOMETRY (odometry) or VISION_POSITION_ESTIMATE (vision)",
    )  # fmt: skip
    parser.add_argument(
        "--pose-rate", type=float, default=POSE_RATE_HZ, metavar="HZ", dest="pose_rate_hz",
        help=f"most poses a second ({POSE_RATE_HZ:g})",
    )  # fmt: skip
    for name, options in RULES.items():
        parser.add_argument(f"--{name.replace('_', '-')}", **options)
    parser.add_argument("--resume", action="store_true", help="continue the map at --out, in the world of its poses")
    add_usual(parser, "profile", "voxel-size", "max-range", "threads")
    add_settings(parser, "deadline_ms=25")
    add_checkpoint(parser)


def run(arguments: Namespace) -> dict[str, Any]:
    """Map until Ctrl-C or SIGTERM, save the map and print a summary."""
    from stereovox.live.run import OUTPUTS, LiveOptions, LiveRun

    check_ending("--sphere", arguments.sphere, ".png")
    rules = _rules(arguments)
    live = LiveRun(_cameras(arguments), arguments.out, **options_of(LiveOptions, arguments))
    with live, ExitStack() as stack:
        say_about_compiling()
        if arguments.view is not None:
            from stereovox.cli.look.view import silence_server_log

            silence_server_log()
        outputs: dict[str, Any] = {name: getattr(arguments, name) for name in OUTPUTS if hasattr(arguments, name)}
        outputs |= {"heights": heights_of(arguments.heights), "rules": rules}
        live.add_outputs(**outputs)
        if live.page:
            say(f"open {live.page} in a browser to see the map grow")
        say("mapping; Ctrl-C ends")
        done = live.finish([stack.enter_context(progress_of(None, "mapping"))])
    result = done.summary()
    _print_result(result, done, arguments)
    return result


def _rules(arguments: Namespace) -> SectorRules | None:
    """Return how obstacle distances are made; raises StereovoxError for options without an autopilot."""
    given = {name: value for name in RULES if (value := getattr(arguments, name)) is not None}
    if not arguments.mavlink and (given or arguments.send_pose):
        option = "--send-pose" if arguments.send_pose else f"--{next(iter(given)).replace('_', '-')}"
        raise StereovoxError(f"{option}: there is no autopilot; give --mavlink URL, its address")
    if not given:
        return None
    from stereovox.mavlink.sectors import SectorRules

    return SectorRules(**given)


def _cameras(arguments: Namespace) -> str | LiveCamera:
    """Return the cameras; raises StereovoxError for a mount together with a file of several."""
    from stereovox.live.rig import LiveCamera, mount_of

    if arguments.mount is None and arguments.clock_offset is None:
        return arguments.source
    if arguments.source.endswith(".toml"):
        raise StereovoxError("--mount, --clock-offset: write them into the file, for each camera")
    given: dict[str, Any] = {}
    if arguments.mount is not None:
        try:
            given["T_body_camera"] = mount_of([float(word) for word in arguments.mount.split(",")])
        except ValueError as error:
            cure = error if isinstance(error, StereovoxError) else "write X,Y,Z,ROLL,PITCH,YAW in metres and degrees"
            raise StereovoxError(f"--mount {arguments.mount}: {cure}") from None
    if arguments.clock_offset is not None:
        given["clock_offset_s"] = arguments.clock_offset
    return LiveCamera(arguments.source, **given)


def _print_result(result: dict[str, Any], done: LiveResult, arguments: Namespace) -> None:
    live = result["live"]
    say_refusals(result, done.reports, "images")
    for name, counts in live["cameras"].items():
        lost = f"{counts['dropped']} dropped"
        early = f", {counts['before_first_pose']} before the first pose" if counts["before_first_pose"] else ""
        slow = f", {counts['late']} late, since it cannot be played at its pace" if counts.get("late") else ""
        failed = f"; failed: {counts['failure']}" if "failure" in counts else ""
        say(f"  {name}: {counts['received']} images received, {lost}{early}{slow}{failed}")
    if "poses" in live:
        say(f"poses of {result['poses']}: {', '.join(f'{count} {what}' for what, count in live['poses'].items())}")
    latency = live["latency_ms"]
    say(f"from {latency['since']} of an image to the map: {milliseconds(latency['map'])}")
    say(f"and to the outputs: {milliseconds(latency['outputs'])}")
    say(f"{100 * live['cpu_share']:.0f} % of a core for {live['seconds']:.1f} s")
    failures = result.get("not_written", ())
    for what, file in (("2-D map", arguments.grid), ("distances in all directions", arguments.sphere)):
        if file and not any(why.startswith(f"{file}:") for why in failures):
            say(f"{what}: {file}")
    if "obstacle_distances" in live:
        say(f"{live['obstacle_distances']} obstacle distances sent to {arguments.mavlink}")
    if "poses_sent" in live:
        say(f"{live['poses_sent']} poses sent to {arguments.mavlink}, {live['pose_resets']} resets")
    if "recorded" in live and not any(why.startswith(f"{arguments.record}:") for why in failures):
        counts = ", ".join(f"{count} {what}" for what, count in live["recorded"].items()) or "nothing"
        say(f"recorded in {arguments.record}: {counts}")
    say(cells_line(result))
    for why in failures:
        say(f"not written: {why}")
    say(f"saved in {arguments.out}{but_few(result)}; look at it with: {command_line('view', arguments.out)}")
