# SPDX-License-Identifier: Apache-2.0
"""Export a map for other programs; the suffix of FILE selects the format.

.bt and .ot for OctoMap, .ply and .pcd for point cloud viewers, .npz for NumPy, .glb for browsers and Blender, .obj and
.stl for 3-D tools, .rrd for the Rerun viewer; .bag, .mcap and .db3 for ROS; .pgm, .png or .yaml for
map_server: the map from above, as an image and its .yaml. A floor map (.yaml) can be exported to a bag too.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import dimensions, open_grid, open_map, refuse_options
from stereovox.cli.options import heights_of, point
from stereovox.cli.terminal import say, size

if TYPE_CHECKING:
    from stereovox.products.floor_heights import FloorHeights

EXAMPLES = """stereovox export kitchen.svox kitchen.bt
stereovox export kitchen.svox kitchen.ply"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map; for a bag also the .yaml of a floor map")
    parser.add_argument("file", metavar="FILE", help="file to write")
    parser.add_argument(
        "--heights",
        metavar="LO:HI",
        help="2-D maps and bags: metres above the floor that a robot occupies (scan.heights); a cell is free if it was"
        " seen free at all of them",
    )
    parser.add_argument(
        "--floor",
        type=float,
        metavar="Z",
        help="2-D maps and bags: height in metres of a level floor in the world (found at each place)",
    )
    parser.add_argument(
        "--start", type=point, metavar="X,Y,Z", help="2-D maps and bags: a place near the floor to use, if several"
    )
    parser.add_argument(
        "--inflate",
        type=float,
        metavar="R",
        help="2-D maps: inflate obstacles by a robot's radius in metres and one cell",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and export it."""
    from stereovox.formats import BAGS, FLAT, export
    from stereovox.products.floor_heights import CURE, NO_FLOOR, FloorHeights, floor_of_map

    file, heights = Path(arguments.file), heights_of(arguments.heights)
    ending = file.suffix.lower()
    if dimensions(arguments.map) == 2 and ending in BAGS:
        return _export_floor(arguments)
    voxel_map = open_map(arguments.map)
    flat = ending in (*FLAT, *BAGS)
    floor = floor_of_map(voxel_map, arguments.floor, arguments.start) if flat else arguments.floor
    export(voxel_map, file, heights, arguments.inflate, floor, None if flat else arguments.start)
    result: dict[str, Any] = {"file": str(file), "bytes": file.stat().st_size}
    beside = ""
    if isinstance(floor, FloorHeights) and floor.known:
        low, high = result["heights"] = heights or voxel_map.config.scan.heights
        say(f"seen from above: {low:g} to {high:g} m above the floor, which is {_format_floor(floor)}")
        say("cells are free if seen free at all these heights; for a lower robot: --heights LO:HI")
    elif flat:
        say(f"without a 2-D map: {NO_FLOOR}; {CURE}")
    if arguments.inflate is not None:
        result["inflated_m"] = arguments.inflate
        say(f"obstacles inflated by {arguments.inflate:g} m and one cell")
    if ending in FLAT:
        beside = f" and {file.with_suffix('.pgm' if ending == '.yaml' else '.yaml')}"
    say(f"saved {file}{beside} ({size(result['bytes'])})")
    return result


def _format_floor(floor: FloorHeights) -> str:
    if not floor.height.size:
        return f"stated to be at {floor.elsewhere:g} m"
    seen = floor.height[floor.away == 0]
    return f"found at each place, {seen.min():.2f} to {seen.max():.2f} m from the world's origin"


def _export_floor(arguments: Namespace) -> dict[str, Any]:
    """Write a floor map to a bag."""
    from stereovox.formats.bags import write_grid_bag

    refuse_options(arguments, ["heights", "inflate", "floor", "start"], "a floor map is written to a bag unchanged")
    write_grid_bag(open_grid(arguments.map), arguments.file)
    say(f"saved {arguments.file}")
    return {"file": arguments.file, "bytes": Path(arguments.file).stat().st_size}
