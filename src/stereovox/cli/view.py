# SPDX-License-Identifier: Apache-2.0
"""Look at a map in the browser: turn it, cut it, and see what the camera's optical axis meets."""

from __future__ import annotations

import logging
import os
from argparse import ArgumentParser, Namespace
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from stereovox.cli.saved_map import open_cubes
from stereovox.cli.terminal import say

TOKEN = "STEREOVOX_TOKEN"
EXAMPLE = "stereovox view kitchen.svox"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument(
        "--up", metavar="AXIS", help="which way is up: z, -y, x ... (default: as the map's settings say)"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve; 0.0.0.0 lets others look who have the link (default here)",
    )
    parser.add_argument("--port", type=int, default=8080, help="port of the page; 0 for any that is free (8080)")
    parser.add_argument(
        "--token",
        metavar="WORD",
        help=f"what the link must hold; better in {TOKEN}, for all users of a machine see its command lines",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Serve the page until Ctrl-C."""
    from stereovox.view.viewer import open_viewer

    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # tells of every browser that hangs up early
    name = Path(arguments.map).stem
    place = arguments.host, arguments.port
    token = arguments.token if arguments.token is not None else os.environ.get(TOKEN) or None
    viewer = open_viewer(open_cubes(arguments.map), name, *place, arguments.up, token)
    with closing(viewer), suppress(KeyboardInterrupt):
        if "?token=" in viewer.url:
            others = "; from another machine put this one's name for localhost" if "//localhost:" in viewer.url else ""
            say(f"whoever has this link can look at the map{others}")
        say(f"open {viewer.url} in a browser; Ctrl-C ends")
        viewer.wait()
    return {"url": viewer.url}
