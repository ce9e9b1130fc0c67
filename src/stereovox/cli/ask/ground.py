# SPDX-License-Identifier: Apache-2.0
"""Find the ground in a map and where a robot can drive; the suffix of FILE selects the format.

.npz for the heights of the ground and the class of each place, .yaml or .pgm for map_server, .png for a
picture.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import open_map
from stereovox.cli.options import check_ending, point
from stereovox.cli.terminal import say, thousands

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap
    from stereovox.products.ground import Ground

EXAMPLES = """stereovox ground room.svox ground.png --height 1.2 --max-step 0.05
stereovox ground room.svox ground.npz"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("file", metavar="FILE", help="file to write: .npz, .yaml, .pgm or .png")
    parser.add_argument(
        "--height",
        type=float,
        default=1.0,
        metavar="M",
        help="height of the robot: clearance above the ground (1 metre)",
    )
    parser.add_argument(
        "--radius",
        type=float,
        default=0.25,
        metavar="M",
        help="radius of the robot, over which the slope is measured (0.25)",
    )
    parser.add_argument("--max-step", type=float, default=0.1, metavar="M", help="highest step the robot climbs (0.1)")
    parser.add_argument("--max-slope", type=float, default=20.0, metavar="DEG", help="steepest ground in degrees (20)")
    parser.add_argument(
        "--start",
        type=point,
        metavar="X,Y,Z",
        help="a point on or near the ground, in metres (the lowest large surface)",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map, find its ground, write it and print a summary."""
    from stereovox.products.ground import Robot, ground

    check_ending("FILE", arguments.file, ".npz", ".yaml", ".pgm", ".png")
    robot = Robot(arguments.height, arguments.radius, arguments.max_step, arguments.max_slope)
    voxel_map = open_map(arguments.map)
    found = ground(voxel_map, robot, arguments.start)
    _write(voxel_map, found, arguments)
    return _print_result(found, arguments.file)


def _write(voxel_map: VoxelMap, found: Ground, arguments: Namespace) -> None:
    ending = Path(arguments.file).suffix.lower()
    if ending == ".png":
        from stereovox.view.above import draw_ground
        from stereovox.view.figures import save

        save(draw_ground(voxel_map, found, f"{Path(arguments.map).stem}: ground"), arguments.file)
    elif ending == ".npz":
        from stereovox.products.ground import write_ground

        write_ground(found, arguments.file)
    else:
        from stereovox.formats.map_server import write_map_server

        write_map_server(found.grid, arguments.file)


def _print_result(found: Ground, file: str) -> dict[str, Any]:
    import numpy as np

    from stereovox.products.ground import Footing

    number = np.bincount(found.footing.ravel(), minlength=len(Footing)).tolist()
    counts = {footing.name.lower(): number[footing] for footing in Footing}
    low, high = (round(float(end), 4) for end in (np.nanmin(found.height), np.nanmax(found.height)))
    say(", ".join(f"{thousands(count)} {name}" for name, count in counts.items() if name != "unknown" and count))
    say(f"ground from {low:g} to {high:g} m high; saved {file}")
    return {"file": file, "resolution": found.resolution, "heights": [low, high], **counts}
