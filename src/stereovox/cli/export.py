# SPDX-License-Identifier: Apache-2.0
"""Write a map for other programs; the ending of FILE chooses the format.

.bt and .ot for OctoMap, .ply for point cloud viewers, .npz for NumPy.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from stereovox.cli.saved_map import open_cubes
from stereovox.cli.terminal import say, size

EXAMPLE = "stereovox export kitchen.svox kitchen.bt"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("file", metavar="FILE", help="file to write")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and write it in the other format."""
    from stereovox.products import export

    file = Path(arguments.file)
    export(open_cubes(arguments.map), file)
    say(f"saved {file} ({size(file.stat().st_size)})")
    return {"file": str(file), "bytes": file.stat().st_size}
