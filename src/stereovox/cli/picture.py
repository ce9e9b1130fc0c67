# SPDX-License-Identifier: Apache-2.0
"""Draw a map as a whole, one layer of it, what the camera's optical axis meets, or its cells in space."""

from __future__ import annotations

import math
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import Any

from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

EXAMPLE = "stereovox picture kitchen.svox kitchen.png --view layer --up=-y"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("file", metavar="FILE.png", help="picture to write")
    parser.add_argument("--view", default="overview", metavar="NAME", help="overview (default), layer, axis or space")
    parser.add_argument("--at", type=float, metavar="M", help="height of the layer along --up (default: the camera's)")
    parser.add_argument(
        "--up", metavar="AXIS", help="which way is up: z, -y, x ... (default: as the map's settings say)"
    )
    parser.add_argument("--eye", type=_point, metavar="X,Y,Z", help="where the camera is (default: the last frame's)")
    parser.add_argument("--toward", type=_point, metavar="X,Y,Z", help="a point on its optical axis; goes with --eye")
    parser.add_argument("--title", metavar="TEXT", help="title instead of the map's name")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and write its picture."""
    from stereovox.maps import load_map
    from stereovox.view.drawn import checked_up
    from stereovox.view.figures import save
    from stereovox.view.views import draw_view
    from stereovox.view.whereabouts import viewpoint_at

    file = Path(arguments.file)
    if file.suffix.lower() != ".png":
        raise StereovoxError(f"{file}: pictures are written as .png; name the file so")
    voxel_map = load_map(arguments.map)
    up = checked_up(arguments.up or voxel_map.config.up)
    viewpoint = viewpoint_at(voxel_map, arguments.eye, arguments.toward, up)
    heading = _plain(arguments.title or Path(arguments.map).stem)
    save(draw_view(voxel_map, arguments.view, heading, up, arguments.at, viewpoint), file)
    say(f"saved {file}")
    return {"picture": str(file)}


def _point(text: str) -> tuple[float, float, float]:
    """Return three numbers in metres."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise ArgumentTypeError(f"'{text}' is no point; give X,Y,Z in metres")
    return x, y, z


def _plain(text: str) -> str:
    """Return text that is drawn letter by letter: no formulas, no bytes that are no letters."""
    return text.encode("utf-8", "replace").decode().replace("$", r"\$")
