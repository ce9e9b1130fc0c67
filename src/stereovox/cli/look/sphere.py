# SPDX-License-Identifier: Apache-2.0
"""Show the distances to the nearest obstacles around a vehicle.

SOURCE is anything that `map` takes; the last frame of each camera counts, seen from the vehicle's last pose.
sim:surround is a drone with four stereo cameras.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_usual, check_ending
from stereovox.cli.terminal import say, say_about_compiling, tracked
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.depth.sphere import Sight

EXAMPLES = """stereovox sphere sim:surround --frames :4 --out sphere.png --step 2
stereovox sphere sim:surround --frames :1 --out one.png"""
STEP_DEG = 1.0
"""Default if neither the options nor the profile set a step."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="recorded folder or file, or a simulation")
    parser.add_argument("--out", metavar="FILE.png", help="picture of all directions to write")
    parser.add_argument("--step", type=float, metavar="DEG", help=f"width of a cell (the profile's, or {STEP_DEG:g})")
    add_usual(parser, "frames")
    parser.add_argument("--profile", default="default", metavar="P", help="profile name or TOML file (default)")
    add_usual(parser, "max-range")


def run(arguments: Namespace) -> dict[str, Any]:
    """Compute the distances, print them and draw them."""
    from stereovox.depth.sphere import surroundings
    from stereovox.depth.sphere.vehicle import vehicle_grid
    from stereovox.opening import open_stream

    check_ending("--out", arguments.out, ".png")
    config = _config(arguments)
    stream = open_stream(arguments.source, arguments.frames)
    if stream.length is None and arguments.frames is None:
        raise StereovoxError(f"{arguments.source}: a live camera never ends; give --frames, for example :30")
    for note in stream.notes:
        _note(note)
    say_about_compiling()
    grid, now_ns, refused = vehicle_grid(tracked(stream, stream.length, "reading"), config, _note)
    sights = surroundings(grid)
    result = {
        "step_deg": config.sphere.step_deg,
        "seen": float(grid.known.mean()),
        "refused": refused,
        "directions": {name: _as_dict(sight, now_ns) for name, sight in sights.items()},
    }
    for name, sight in sights.items():
        say(f"{name:>6}: {_format_sight(sight, now_ns)}")
    if arguments.out:
        from stereovox.view.sphere import sphere_picture

        sphere_picture(grid, arguments.out, title=str(arguments.source).replace("$", r"\$"), now_ns=now_ns)
        say(f"saved {arguments.out}")
    return {**result, "picture": arguments.out}


def _note(line: str) -> None:
    say(f"note: {line}")


def _config(arguments: Namespace) -> Any:
    from stereovox.config import load_config

    overrides: dict[str, Any] = {}
    if arguments.max_range is not None:
        overrides["max_range"] = arguments.max_range
    step = arguments.step or load_config(arguments.profile).sphere.step_deg or STEP_DEG
    return load_config(arguments.profile, **overrides, **{"sphere.step_deg": step})


def _as_dict(sight: Sight | None, now_ns: int) -> dict[str, Any] | None:
    if sight is None:
        return None
    return {
        "range_m": round(sight.range_m, 4),
        "surface": sight.surface,
        "age_s": round(sight.age_s(now_ns), 6),
        "seen": round(sight.seen, 4),
    }


def _format_sight(sight: Sight | None, now_ns: int) -> str:
    if sight is None:
        return "unknown"
    what = f"{sight.range_m:.2f} m" if sight.surface else f"free up to {sight.range_m:.2f} m"
    return f"{what}, {sight.age_s(now_ns):.2f} s ago; {100 * sight.seen:.0f} % of these directions seen"
