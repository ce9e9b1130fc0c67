# SPDX-License-Identifier: Apache-2.0
"""Check whether a body can follow a path through a map, where it is blocked, and how old the evidence is.

The path is straight between its points; the body is a ball. Unknown cells block it too.
"""

from __future__ import annotations

import re
from argparse import ArgumentParser, Namespace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.maps import open_map
from stereovox.cli.options import check_ending, point
from stereovox.cli.terminal import say

if TYPE_CHECKING:
    from stereovox.products.path_check import PathCheck

EXAMPLES = """stereovox path kitchen.svox 0,0,0 1,0,0 1,0.5,0 --radius 0.3
stereovox path kitchen.svox 0,0,0 1,0,0 --radius 0.3 --json"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser._negative_number_matcher = re.compile(r"-\.?\d")  # a point may begin with a minus: -1,0,0
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("point", type=point, metavar="X,Y,Z", nargs="+", help="two points or more, in metres")
    parser.add_argument("--radius", type=float, required=True, metavar="R", help="radius of the body in metres")
    parser.add_argument("--through-unknown", action="store_true", help="unknown cells do not block the path")
    parser.add_argument(
        "--picture", metavar="FILE.png", help="picture of the path: from above, from the side, clearance along it"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Check the path and print the result."""
    from stereovox.maps import State
    from stereovox.products.path_check import check_path, point_along

    check_ending("--picture", arguments.picture, ".png")
    voxel_map = open_map(arguments.map)
    points = np.array(arguments.point)
    found = check_path(voxel_map, points, arguments.radius, arguments.through_unknown)
    states = [State(state).name.lower() for state in found.worst]
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    stopped = None if found.blocked_at is None else point_along(points, found.blocked_at).round(6).tolist()
    oldest = (
        None
        if found.oldest_s is None
        else [round(age, 3) if isfinite(age) else None for age in found.oldest_s.tolist()]
    )
    for n, state in enumerate(states):
        age = (
            "" if oldest is None or oldest[n] is None else f", oldest evidence {oldest[n]:.1f} s before the last frame"
        )
        say(f"{n + 1}. {_format_point(points[n])} to {_format_point(points[n + 1])}, {lengths[n]:.2f} m: {state}{age}")
    say(_format_verdict(found, float(lengths.sum()), stopped))
    if arguments.picture:
        from stereovox.view.path import picture_path

        title = f"A path through {Path(arguments.map).stem}"
        picture_path(voxel_map, points, arguments.radius, arguments.picture, title, found.blocked_at)
        say(f"saved {arguments.picture}")
    return {
        "free": found.free,
        "length_m": float(lengths.sum()),
        "blocked_at_m": found.blocked_at,
        "blocked_at": stopped,
        "segments": states,
        "oldest_s": oldest,
    }


def _format_verdict(found: PathCheck, length: float, stopped: list[float] | None) -> str:
    if found.blocked_at is None or stopped is None:
        return f"free over {length:.2f} m"
    return f"blocked after {found.blocked_at:.2f} of {length:.2f} m, at {_format_point(stopped)}"


def _format_point(point: Any) -> str:
    return f"({', '.join(f'{x:.6g}' for x in np.round(point, 3) + 0.0)})"
