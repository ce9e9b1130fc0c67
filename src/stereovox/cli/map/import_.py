# SPDX-License-Identifier: Apache-2.0
"""Import a map from another program; the suffix of FILE selects the format.

.bt, .ot and .graph of OctoMap; .npz of stereovox; clouds and meshes (.ply, .pcd, .las, .laz, .xyz, .csv, .txt, .asc,
.pts, .bin of KITTI, .stl, .obj, .off): each cell that holds a point or a piece of surface becomes occupied; .bag,
.mcap, .db3 and rosbag2 folders with an octomap_msgs/Octomap or a PointCloud2; .yaml of map_server with --heights. The
size of cells is suggested if it is not given. If MAP ends in .yaml, .pgm or .png, FILE is a floor map, or a bag with a
nav_msgs/OccupancyGrid, and is saved as map_server files.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import check_new_floor, open_grid, refuse_options
from stereovox.cli.options import heights_of, numbers_of
from stereovox.cli.terminal import say, thousands
from stereovox.errors import StereovoxError
from stereovox.files.safe_io import FLOOR_ENDINGS

if TYPE_CHECKING:
    from stereovox.maps.occupancy import OccupancyGrid

EXAMPLES = """stereovox import building.bt building.svox
stereovox import scan.las scan.svox --voxel-size 0.1"""
SUFFIXES_2D = (".yaml", ".yml", ".pgm", ".png", ".bmp")
"""Suffixes of floor maps."""
SUFFIXES_BAG = (".bag", ".mcap", ".db3", "")
"""Suffixes of bags, which may hold both; none for a folder."""
CLOUD_OPTIONS = ("voxel_size", "unit", "origin")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", metavar="FILE", help="file to read")
    parser.add_argument("map", metavar="MAP", help="folder of the new map, or the .yaml of a floor map")
    parser.add_argument("--voxel-size", type=float, metavar="M", help="side of a cell in metres (suggested by points)")
    parser.add_argument("--unit", metavar="U", help="unit of points: m, cm, mm, ft or us-ft (the file's own, else m)")
    parser.add_argument("--origin", metavar="X,Y,Z", help="point of the file, in metres, that becomes the map's origin")
    parser.add_argument("--heights", metavar="LO:HI", help="lowest and highest metres of the walls of a floor map")
    parser.add_argument("--topic", metavar="T", help="topic in the bag, if there are several")


def run(arguments: Namespace) -> dict[str, Any]:
    """Read the file and save the map."""
    return (_import_grid if Path(arguments.map).suffix.lower() in FLOOR_ENDINGS else _import_cells)(arguments)


def _import_cells(arguments: Namespace) -> dict[str, Any]:
    from stereovox.formats import import_map

    origin = None if arguments.origin is None else numbers_of("--origin", arguments.origin, "X,Y,Z")
    voxel_map = import_map(
        arguments.file,
        arguments.voxel_size,
        arguments.topic,
        unit=arguments.unit,
        origin=origin,
        heights=heights_of(arguments.heights),
    )
    voxel_map.save(arguments.map)
    counts = voxel_map.counts()
    say(voxel_map.history.made_of())
    say(", ".join(f"{thousands(counts[state])} {state}" for state in ("occupied", "free", "tentative")))
    say(f"saved {arguments.map}")
    return {"map": arguments.map, "voxel_size": voxel_map.voxel_size, **counts}


def _import_grid(arguments: Namespace) -> dict[str, Any]:
    from stereovox.formats.map_server import write_map_server

    ending = Path(arguments.file).suffix.lower()
    if ending not in (*SUFFIXES_2D, *SUFFIXES_BAG) and not Path(arguments.file).is_dir():
        raise StereovoxError(
            f"{arguments.file}: holds a 3-D map; import it as M.svox, then: stereovox export M.svox floor.yaml"
        )
    refuse_options(arguments, [*CLOUD_OPTIONS, "heights"], "a floor map defines its own cells")
    grid, mode = _read_floor(arguments) if ending in SUFFIXES_2D else _read_bag(arguments)
    write_map_server(grid, arguments.map, mode)
    rows, columns = grid.cells.shape
    say(f"{columns} x {rows} cells of {grid.resolution:g} m; saved {arguments.map}")
    return {"map": arguments.map, "voxel_size": grid.resolution, "columns": columns, "rows": rows}


def _read_bag(arguments: Namespace) -> tuple[OccupancyGrid, str]:
    from stereovox.formats.bags import read_bag_grid

    return read_bag_grid(arguments.file, arguments.topic), "trinary"


def _read_floor(arguments: Namespace) -> tuple[OccupancyGrid, str]:
    """Return a floor map and the mode to write it in: its own, so that no value is lost."""
    from stereovox.formats.map_server import metadata_of

    refuse_options(arguments, ["topic"], "a floor map has no topics")
    metadata = metadata_of(arguments.file)
    check_new_floor(arguments.map, arguments.file, metadata.image)
    return open_grid(arguments.file), metadata.mode
