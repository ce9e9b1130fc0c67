# SPDX-License-Identifier: Apache-2.0
"""Write a map for other programs; the ending of FILE chooses the format.

.bt and .ot for OctoMap, .ply for point cloud viewers, .npz for NumPy, .rrd for the Rerun viewer; .pgm, .png or .yaml
for map_server: the map seen from above, as a picture and its .yaml.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from stereovox.cli.saved_map import open_cubes, open_map
from stereovox.cli.terminal import say, size
from stereovox.errors import StereovoxError

EXAMPLE = "stereovox export kitchen.svox kitchen.bt"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("file", metavar="FILE", help="file to write")
    parser.add_argument(
        "--heights",
        metavar="LO:HI",
        help="2-D maps: heights in metres between which obstacles count (the map's scan.heights); what is free at any"
        " height is cleared. Below zero: --heights=-0.5:1",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and write it in the other format."""
    from stereovox.products import FLAT, export

    file, heights = Path(arguments.file), _heights(arguments.heights)
    flat = file.suffix.lower() in FLAT
    voxel_map = open_map(arguments.map) if flat else open_cubes(arguments.map)  # seen from above, most need no cubes
    export(voxel_map, file, heights)
    result: dict[str, Any] = {"file": str(file), "bytes": file.stat().st_size}
    if flat:
        low, high = result["heights"] = heights or voxel_map.config.scan.heights
        say(f"seen from above: what is {low:g} to {high:g} m high marks a cell; others: --heights=LO:HI")
        beside = file.with_suffix(".pgm" if file.suffix.lower() == ".yaml" else ".yaml")
        say(f"saved {file} and {beside}")
    else:
        say(f"saved {file} ({size(file.stat().st_size)})")
    return result


def _heights(text: str | None) -> tuple[float, float] | None:
    """Return what --heights says; raises StereovoxError where that is not LO:HI."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        heights = float(low), float(high)
    except ValueError:
        raise StereovoxError(f"--heights {text}: write LO:HI in metres, for example --heights 0.1:1.8") from None
    if not heights[0] < heights[1]:
        raise StereovoxError(f"--heights {text}: the second must be higher than the first")
    return heights
