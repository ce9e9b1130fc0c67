# SPDX-License-Identifier: Apache-2.0
"""Draw a map: an overview, one layer, the optical axis, or the cells in space with the camera's field of view."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

EXAMPLE = "stereovox picture kitchen.svox kitchen.png --up=-y"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("file", metavar="FILE.png", help="picture to write")
    parser.add_argument("--view", default="overview", metavar="NAME", help="overview (default), layer, axis or space")
    parser.add_argument("--at", type=float, metavar="M", help="height of the layer; by default the camera's")
    parser.add_argument("--up", metavar="AXIS", help="which way is up: z, -y, x ... (as the map's settings say)")
    parser.add_argument("--title", metavar="TEXT", help="title instead of the map's name")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and write its picture."""
    from stereovox.maps import load_map
    from stereovox.view.figures import save
    from stereovox.view.views import draw_view

    file = Path(arguments.file)
    if file.suffix.lower() != ".png":
        raise StereovoxError(f"{file}: pictures are written as .png; name the file so")
    voxel_map = load_map(arguments.map)
    heading = _plain(arguments.title or Path(arguments.map).stem)
    save(draw_view(voxel_map, arguments.view, heading, arguments.up or voxel_map.config.up, arguments.at), file)
    say(f"saved {file}")
    return {"picture": str(file)}


def _plain(text: str) -> str:
    """Return text that is drawn letter by letter: no formulas, no bytes that are no letters."""
    return text.encode("utf-8", "replace").decode().replace("$", r"\$")
