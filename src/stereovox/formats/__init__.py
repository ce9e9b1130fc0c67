# SPDX-License-Identifier: Apache-2.0
"""Import and export of maps: one reader and one writer per file type, selected by the file name's ending."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

from numpy.typing import ArrayLike

from stereovox import registry
from stereovox.errors import StereovoxError, did_you_mean
from stereovox.formats.octomap import read_octomap
from stereovox.maps import VoxelMap
from stereovox.maps.files.store import is_map
from stereovox.maps.record.history import Imported
from stereovox.maps.storage.cubes import in_cubes
from stereovox.products.floor_heights import FloorHeights

CLOUDS = (".ply", ".pcd", ".las", ".laz", ".xyz", ".csv", ".txt", ".asc", ".pts", ".ptx", ".bin", ".stl", ".obj",
          ".off")  # fmt: skip
"""Endings of point clouds and meshes."""
FLOORS = (".yaml", ".yml", ".pgm", ".png", ".bmp")
"""Endings of 2-D maps that can be read."""
IMPORTS = {
    ".bt": "stereovox.formats.octomap:read_octomap",
    ".ot": "stereovox.formats.octomap:read_octomap",
    ".npz": "stereovox.formats.points:read_npz",
    ".graph": "stereovox.formats.scan_graph:read_scan_graph",
    **dict.fromkeys(CLOUDS, "stereovox.formats.clouds:read_cloud_map"),
    **dict.fromkeys(FLOORS, "stereovox.formats.cell_size:read_raised_floor"),
    ".bag": "stereovox.formats.bags:read_bag_map",
    ".mcap": "stereovox.formats.bags:read_bag_map",
    ".db3": "stereovox.formats.bags:read_bag_map",
}
"""File ending -> reader `(path) -> VoxelMap`; other packages add theirs as entry points `stereovox.import`."""
OPTIONS = {
    "voxel_size": (*CLOUDS, ".graph", ".bag", ".mcap", ".db3"),
    "unit": CLOUDS,
    "origin": CLOUDS,
    "heights": FLOORS,
    "topic": (".bag", ".mcap", ".db3"),
}
"""Endings whose readers take these keyword arguments."""
UNREADABLE = {
    ".vdb": "no Python package reads OpenVDB grids here; write the centres of its active voxels as .xyz, one a line",
    ".bonxai": "Bonxai's files have no reader in Python; write the cells of forEachCell as .xyz, x y z a line",
    ".e57": "convert it with CloudCompare (save as .laz), or with: pdal translate scan.e57 scan.laz",
    **dict.fromkeys((".splat", ".ksplat", ".spz", ".sog"), "holds Gaussian splats; let SuperSplat export them as .ply"),
    ".pcap": "holds lidar packets; let the lidar's driver write a bag or .pcd",
    ".svox": "is already a map; open it with stereovox info, picture or view",
    ".pbstream": "is Cartographer's state; let cartographer_pbstream_to_ros_map write a .yaml",
    ".drc": "is packed by Draco; convert it to .ply",
    ".zip": "unpack it first",
    ".gz": "unpack it first",
    ".bz2": "unpack it first",
}
"""Remedies for files that cannot be imported, by ending."""
LFS = b"version https://git-lfs"
"""Start of the pointer that git-lfs leaves in place of a large file."""
EXPORTS = {
    ".bt": "stereovox.formats.octomap:write_bt",
    ".ot": "stereovox.formats.octomap:write_ot",
    ".ply": "stereovox.formats.points:write_ply",
    ".pcd": "stereovox.formats.points:write_pcd",
    ".npz": "stereovox.formats.points:write_npz",
    ".glb": "stereovox.formats.meshes:write_glb",
    ".obj": "stereovox.formats.meshes:write_obj",
    ".stl": "stereovox.formats.meshes:write_stl",
    ".bag": "stereovox.formats.bags:write_bag",
    ".mcap": "stereovox.formats.bags:write_bag",
    ".db3": "stereovox.formats.bags:write_bag",
    ".rrd": "stereovox.formats.rerun:write_rrd",
    ".pgm": "stereovox.formats.map_server:write_grid",
    ".png": "stereovox.formats.map_server:write_grid",
    ".yaml": "stereovox.formats.map_server:write_grid",
}
"""File ending -> writer `(voxel_map, path) -> None`; other packages add theirs as entry points `stereovox.export`."""
FLAT = (".pgm", ".png", ".yaml")
"""Endings of 2-D maps, whose writers also take `heights` and `inflate`."""
BAGS = (".bag", ".mcap", ".db3")
"""Endings of ROS recordings, with a 2-D map in them, whose writers also take `heights`."""
__all__ = ["BAGS", "CLOUDS", "EXPORTS", "FLAT", "FLOORS", "IMPORTS", "export", "import_map", "read_octomap"]


def export(
    voxel_map: VoxelMap,
    path: str | Path,
    heights: tuple[float, float] | None = None,
    inflate: float | None = None,
    floor: FloorHeights | float | None = None,
    start: ArrayLike | None = None,
) -> None:
    """Write a map in the format that the file name's ending selects; a failed export leaves an older file intact.

    Cells that are not cubes are resampled to cubes if the format requires it.

    Args:
        voxel_map: The map.
        path: File to write; `EXPORTS` lists the endings.
        heights: For 2-D maps and bags: lowest and highest metres above the floor that a robot occupies (see
            `projection.project`).
        inflate: For 2-D maps: robot radius in metres by which obstacles grow (see `projection.inflated_grid`).
        floor: For 2-D maps and bags: the floor, or the height in metres of a level one in the world; None: find
            it. A bag of a map without a floor holds no 2-D map.
        start: For 2-D maps and bags: (3,) metres, near the desired floor if there are several.

    Raises:
        StereovoxError: Unknown ending, unwritable path, cells that the format cannot hold, no floor, or an option
            that does not apply to this format.
    """
    ending = Path(path).suffix.lower()
    known = registry.names("export", EXPORTS)
    if ending not in known:
        raise StereovoxError(f"{path}: cannot export to '{ending}'; end the file's name with one of {', '.join(known)}")
    of_floor = {"heights": heights, "floor": floor, "start": start}
    for name, value in of_floor.items():
        if value is not None and ending not in (*FLAT, *BAGS):
            known = " or ".join((*FLAT, *BAGS))
            raise StereovoxError(f"{path}: {name} is for 2-D maps only; end the file's name with {known}")
    if inflate is not None and ending not in FLAT:
        raise StereovoxError(f"{path}: only 2-D maps are inflated; end the file's name with {' or '.join(FLAT)}")
    options = {**of_floor, "inflate": inflate}
    given = {name: value for name, value in options.items() if value is not None}
    write = registry.find("export", EXPORTS, ending)
    write(voxel_map if ending in FLAT else in_cubes(voxel_map), path, **given)


def import_map(
    path: str | Path,
    voxel_size: float | None = None,
    topic: str | None = None,
    *,
    unit: str | None = None,
    origin: Sequence[float] | None = None,
    heights: tuple[float, float] | None = None,
) -> VoxelMap:
    """Read a map from another program's file, or from one that `export` wrote.

    `.bt`, `.ot`: OctoMap's cells. `.graph`: OctoMap's scans, which also mark free space. `.npz`: ours, exactly.
    Point clouds and meshes (`CLOUDS`): each cell that holds a point or a piece of surface is occupied, all others are
    unknown. `.bag`, `.mcap`, `.db3` or a rosbag2 folder: the last Octomap, or PointCloud2, of a topic. Floors
    (`FLOORS`): their cells as columns between `heights`. Choices made for missing options are recorded in the map's
    `history.imported`.

    Args:
        path: File or rosbag2 folder.
        voxel_size: Metres, for points; None: a size suggested by their density, or that in our own files.
        topic: Topic in a bag (see `bags.read_bag_map`).
        unit: Unit of points: `m`, `cm`, `mm`, `ft` or `us-ft`; None: the file's own, else metres.
        origin: (3,) point of the file, in metres, that becomes the map's origin; None: 0, or if points are more than
            10 km from it, a point among them.
        heights: Lowest and highest metres between which a floor's map is raised.

    Returns:
        The map.

    Raises:
        StereovoxError: The file is invalid, or an option does not apply to this kind of file.
    """
    ending = ".mcap" if Path(path).is_dir() and not is_map(path) else Path(path).suffix.lower()
    known = registry.names("import", IMPORTS)
    if ending not in known:
        raise StereovoxError(f"{path}: {_cure(ending, known)}")
    options = {"voxel_size": voxel_size, "topic": topic, "unit": unit, "origin": origin, "heights": heights}
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if ending not in OPTIONS[name]:
            option = f"--{name.replace('_', '-')}"
            raise StereovoxError(f"{path}: {option} does not apply to '{ending}' files; leave it out")
    _check_content(Path(path))
    made = registry.find("import", IMPORTS, ending)(path, **given)
    if made.history.imported is None:
        made.history.imported = Imported(Path(path).name, ending[1:])
    return made


def _cure(ending: str, known: Sequence[str]) -> str:
    if ending in UNREADABLE:
        return UNREADABLE[ending]
    if not ending:
        return f"has no ending that identifies its format; rename it to one of {' '.join(sorted(known))}"
    return (
        f"cannot import '{ending}'{did_you_mean(ending, known) if get_close_matches(ending, known) else ''}; points as "
        "text end in .xyz, clouds in .ply, .pcd or .las, OctoMap's files in .bt, .ot or .graph; "
        "all kinds: stereovox import --help"
    )


def _check_content(path: Path) -> None:
    """Raise StereovoxError if git left a pointer in place of a large file."""
    try:
        if not path.is_file():  # a pipe would block
            return
        with path.open("rb") as file:
            pointer = file.read(len(LFS)) == LFS
    except OSError:
        return  # the reader reports the error
    if pointer:
        raise StereovoxError(f"{path}: is a pointer of git-lfs, not the file; fetch it with: git lfs pull")
