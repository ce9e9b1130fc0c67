# SPDX-License-Identifier: Apache-2.0
"""Import a map from another program; the suffix of FILE selects the format.

.bt and .ot of OctoMap, .npz of stereovox, .ply and .pcd (each cell that holds a point becomes occupied), and .bag,
.mcap, .db3 and rosbag2 folders with an octomap_msgs/Octomap. Where MAP ends in .yaml, .pgm or .png, the bag's
nav_msgs/OccupancyGrid is saved as map_server files.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from stereovox.cli.maps import refuse_options
from stereovox.cli.terminal import say, thousands
from stereovox.errors import StereovoxError
from stereovox.safe_io import FLOOR_ENDINGS

EXAMPLE = "stereovox import building.bt building.svox"
SUFFIXES_3D = (".bt", ".ot", ".npz", ".ply", ".pcd")
"""Suffixes of 3-D maps, which hold no floor map."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", metavar="FILE", help="file to read")
    parser.add_argument("map", metavar="MAP", help="folder of the new map, or the .yaml of a floor map")
    parser.add_argument("--voxel-size", type=float, metavar="M", help="side of a cell in metres, for points")
    parser.add_argument("--topic", metavar="T", help="topic in the bag, where there are several")


def run(arguments: Namespace) -> dict[str, Any]:
    """Read the file and save the map."""
    return (_import_grid if Path(arguments.map).suffix.lower() in FLOOR_ENDINGS else _import_cells)(arguments)


def _import_cells(arguments: Namespace) -> dict[str, Any]:
    from stereovox.formats import import_map

    voxel_map = import_map(arguments.file, arguments.voxel_size, arguments.topic)
    voxel_map.save(arguments.map)
    counts = voxel_map.counts()
    say(", ".join(f"{thousands(counts[state])} {state}" for state in ("occupied", "free", "tentative")))
    say(f"saved {arguments.map}")
    return {"map": arguments.map, "voxel_size": voxel_map.voxel_size, **counts}


def _import_grid(arguments: Namespace) -> dict[str, Any]:
    from stereovox.formats.bags import read_bag_grid
    from stereovox.formats.map_server import write_map_server

    if Path(arguments.file).suffix.lower() in SUFFIXES_3D:
        raise StereovoxError(
            f"{arguments.file}: holds a map in space; import it as M.svox, then: stereovox export M.svox floor.yaml"
        )
    refuse_options(arguments, ["voxel_size"], "a floor's map tells how large its cells are")
    grid = read_bag_grid(arguments.file, arguments.topic)
    write_map_server(grid, arguments.map)
    rows, columns = grid.cells.shape
    say(f"{columns} x {rows} cells of {grid.resolution:g} m; saved {arguments.map}")
    return {"map": arguments.map, "voxel_size": grid.resolution, "columns": columns, "rows": rows}
