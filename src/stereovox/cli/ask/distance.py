# SPDX-License-Identifier: Apache-2.0
"""Write the distance from each cell of a box to the nearest obstacle (an unsigned ESDF), for planners.

FILE.npz holds the arrays distance (x, y, z) in metres, origin and cell.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.maps import open_map
from stereovox.cli.options import CORNERS, check_ending, numbers_of
from stereovox.cli.terminal import say, size, thousands
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stereovox.maps import VoxelMap
    from stereovox.products.distance import DistanceField

EXAMPLES = """stereovox distance kitchen.svox kitchen.npz --to unknown --max 2 --picture distance.png
stereovox distance kitchen.svox near.npz --box=-1,-1,0,1,1,2"""
STATES = ("occupied", "tentative", "unknown")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("file", metavar="FILE.npz", help="file to write")
    parser.add_argument(
        "--to",
        action="append",
        choices=STATES[1:],
        default=[],
        help="cells that count as obstacles besides occupied ones; repeatable",
    )
    parser.add_argument(
        "--box", metavar=CORNERS, help="lowest and highest corner in metres (default: the known part of the map)"
    )
    parser.add_argument("--max", type=float, metavar="M", default=np.inf, help="ignore obstacles farther away")
    parser.add_argument(
        "--measure",
        metavar="HOW",
        default="centres",
        help="from the cell's centre to the obstacle's (centres, default), to its nearest face (faces), or from the"
        " nearest point of the cell (gap)",
    )
    parser.add_argument("--picture", metavar="FILE.png", help="also write a picture of one layer")
    parser.add_argument("--at", type=float, metavar="M", help="height of that layer (default: the camera's)")


def run(arguments: Namespace) -> dict[str, Any]:
    """Compute the distances, write them and print a summary."""
    from stereovox.maps import State
    from stereovox.products.distance import DistanceField, write_distance

    _check_files(arguments)
    voxel_map = open_map(arguments.map)
    low, high = _box(arguments.box, voxel_map)
    to = [State[name.upper()] for name in ("occupied", *arguments.to)]
    field = DistanceField(voxel_map, low, high, to=to, max_distance=arguments.max, measure=arguments.measure)
    write_distance(field, arguments.file)
    result = _print_result(field, arguments)
    if arguments.picture:
        _draw(field, voxel_map, arguments)
        result["picture"] = arguments.picture
    return result


def _check_files(arguments: Namespace) -> None:
    check_ending("FILE", arguments.file, ".npz")
    check_ending("--picture", arguments.picture, ".png")
    if arguments.at is not None and not arguments.picture:
        raise StereovoxError("--at: is the height of the layer to draw; it needs --picture FILE.png")


def _box(text: str | None, voxel_map: VoxelMap) -> NDArray[np.float64]:
    """Return the lowest and the highest corner (2, 3) in metres."""
    bounds = voxel_map.bounds()
    if bounds is None:
        raise StereovoxError("the map is empty, so there are no distances; map something first")
    if text is None:
        return bounds
    return np.reshape(numbers_of("--box", text, CORNERS), (2, 3))


def _print_result(field: DistanceField, arguments: Namespace) -> dict[str, Any]:
    metres, file = field.metres, Path(arguments.file)
    near = metres[np.isfinite(metres)]
    shape, largest = list(metres.shape), float(near.max()) if len(near) else None
    x, y, z = shape
    say(f"{x} x {y} x {z} cells from ({', '.join(f'{place:g}' for place in field.origin)}) m")
    far = "none is near enough" if largest is None else f"distances up to {largest:.2f} m"
    say(f"{thousands(int(field.obstacles.sum()))} obstacles ({', '.join(('occupied', *arguments.to))}); {far}")
    say(f"saved {file} ({size(file.stat().st_size)})")
    return {
        "file": str(file),
        "shape": shape,
        "origin": field.origin.round(9).tolist(),
        "cell": field.cell.tolist(),
        "obstacles": int(field.obstacles.sum()),
        "largest_m": largest,
    }


def _draw(field: DistanceField, voxel_map: VoxelMap, arguments: Namespace) -> None:
    from stereovox.view.drawn import turned
    from stereovox.view.path import picture_distance

    at_m, up = arguments.at, voxel_map.config.up
    if at_m is None and voxel_map.viewpoint is not None:
        camera = voxel_map.viewpoint.T_world_camera[:3, 3]
        at_m = float(turned(camera, up)[2]) if np.isfinite(field.distance(camera))[0] else None
    to = " or ".join(("occupied", *arguments.to))
    picture_distance(field, arguments.picture, up, at_m, f"{Path(arguments.map).stem}: distance to {to} cells")
    say(f"saved {arguments.picture}")
