# SPDX-License-Identifier: Apache-2.0
"""View a map in the browser: turn it, cut it, measure in it, and replay the recording that it was made from."""

from __future__ import annotations

import logging
import os
from argparse import ArgumentParser, Namespace
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import open_map, refuse_options
from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.opening import Source

TOKEN = "STEREOVOX_TOKEN"
EXAMPLES = """stereovox view kitchen.svox
stereovox view kitchen.svox --port 8081"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument(
        "--recording", metavar="SOURCE", help="recording the map was made from: adds a timeline with depth images"
    )
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames of --recording, as a Python slice")
    parser.add_argument(
        "--up", metavar="AXIS", help="axis that points up: z, -y, x ... (default: from the map's settings)"
    )
    parser.add_argument(
        "--most-cells",
        type=int,
        default=250_000,
        metavar="N",
        help="approximate number of cells drawn at once; far ones are drawn coarser (250000; 20000 without a GPU)",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve (127.0.0.1); 0.0.0.0 lets others with the link view the map",
    )
    parser.add_argument("--port", type=int, default=8080, help="port of the page; 0 for any free one (8080)")
    parser.add_argument(
        "--token",
        metavar="WORD",
        help=f"secret of the link; better set {TOKEN}, since all users of a machine can see its command lines",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Serve the page until Ctrl-C."""
    from stereovox.maps.storage.cubes import in_cubes
    from stereovox.viewer.viewer import open_viewer

    silence_server_log()
    voxel_map = open_map(arguments.map)
    if arguments.recording is not None:
        _check_poses(voxel_map.recording)
    source = _recording(arguments, voxel_map.config)
    name, place = Path(arguments.map).stem, (arguments.host, arguments.port)
    token = arguments.token if arguments.token is not None else os.environ.get(TOKEN) or None
    viewer = open_viewer(in_cubes(voxel_map), name, *place, arguments.up, token, arguments.most_cells)
    with closing(viewer), suppress(KeyboardInterrupt):
        if source is not None:
            from stereovox.viewer.frame import Replay

            Replay(viewer, source, voxel_map.config)
        if "?token=" in viewer.url:
            others = "; elsewhere, replace localhost by this machine's name" if "//localhost:" in viewer.url else ""
            say(f"anyone with this link can view the map{others}")
        say(f"open {viewer.url} in a browser; Ctrl-C ends")
        viewer.wait()
    return {"url": viewer.url}


def silence_server_log() -> None:
    """Keep the server from logging every browser that disconnects early."""
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)


def _check_poses(recording: str) -> None:
    """Raise StereovoxError for a map whose poses are not its recording's own."""
    from stereovox.runs.pose_choice import GIVEN, poses_of

    if poses_of(recording) != GIVEN:
        raise StereovoxError(f"--recording: the map was made of '{recording}', with poses that it lacks; leave it out")


def _recording(arguments: Namespace, config: Config) -> Source | None:
    """Return the recording to replay, in the world of a levelled map; None without --recording.

    Raises StereovoxError for a live camera.
    """
    if arguments.recording is None:
        refuse_options(arguments, ("frames",), "selects frames of --recording, which is not given")
        return None
    from stereovox.opening import open_source
    from stereovox.products.moved import level_transform
    from stereovox.sources.paced import TurnedRecording

    source = open_source(arguments.recording, arguments.frames)
    if config.levelled_from is None:
        return source
    return TurnedRecording(source, level_transform(config.levelled_from))
