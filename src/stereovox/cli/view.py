# SPDX-License-Identifier: Apache-2.0
"""Look at a map in the browser: turn it, cut it, measure in it, and replay the recording that it was made of."""

from __future__ import annotations

import logging
import os
from argparse import ArgumentParser, Namespace
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import open_map, refuse_options
from stereovox.cli.terminal import say

if TYPE_CHECKING:
    from stereovox.opening import Source

TOKEN = "STEREOVOX_TOKEN"
EXAMPLE = "stereovox view kitchen.svox"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument(
        "--recording", metavar="SOURCE", help="what the map was made of: adds a timeline with depth images"
    )
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames of --recording, as a Python slice")
    parser.add_argument(
        "--up", metavar="AXIS", help="which way is up: z, -y, x ... (default: as the map's settings say)"
    )
    parser.add_argument(
        "--most-cells",
        type=int,
        default=250_000,
        metavar="N",
        help="cells drawn at once, about; far ones are drawn coarser (250000; 20000 without a graphics card)",
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
    from stereovox.maps.cubes import in_cubes
    from stereovox.viewer.viewer import open_viewer

    quiet()
    voxel_map, source = open_map(arguments.map), _recording(arguments)
    name, place = Path(arguments.map).stem, (arguments.host, arguments.port)
    token = arguments.token if arguments.token is not None else os.environ.get(TOKEN) or None
    viewer = open_viewer(in_cubes(voxel_map), name, *place, arguments.up, token, arguments.most_cells)
    with closing(viewer), suppress(KeyboardInterrupt):
        if source is not None:
            from stereovox.viewer.replay import Replay

            Replay(viewer, source, voxel_map.config)
        if "?token=" in viewer.url:
            others = "; from another machine put this one's name for localhost" if "//localhost:" in viewer.url else ""
            say(f"whoever has this link can look at the map{others}")
        say(f"open {viewer.url} in a browser; Ctrl-C ends")
        viewer.wait()
    return {"url": viewer.url}


def quiet() -> None:
    """Keep the server from telling of every browser that hangs up early."""
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)


def _recording(arguments: Namespace) -> Source | None:
    """Return the recording to replay, if one is named; raises StereovoxError for a live camera."""
    if arguments.recording is None:
        refuse_options(arguments, ("frames",), "picks frames of --recording, which is not given")
        return None
    from stereovox.opening import open_source

    return open_source(arguments.recording, arguments.frames)
