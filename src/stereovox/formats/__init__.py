# SPDX-License-Identifier: Apache-2.0
"""Import and export of maps: one reader and one writer per file type, chosen by the file name's ending."""

from __future__ import annotations

from pathlib import Path

from stereovox import registry
from stereovox.errors import StereovoxError
from stereovox.formats.octomap import read_octomap
from stereovox.maps import VoxelMap
from stereovox.maps.cubes import in_cubes

IMPORTS = {
    ".bt": "stereovox.formats.octomap:read_octomap",
    ".ot": "stereovox.formats.octomap:read_octomap",
    ".npz": "stereovox.formats.read_points:read_npz",
    ".ply": "stereovox.formats.read_points:read_point_map",
    ".pcd": "stereovox.formats.read_points:read_point_map",
    ".bag": "stereovox.formats.bags:read_bag_map",
    ".mcap": "stereovox.formats.bags:read_bag_map",
    ".db3": "stereovox.formats.bags:read_bag_map",
}
"""File ending -> reader `(path) -> VoxelMap`; other packages add theirs as entry points `stereovox.import`."""
OPTIONS = {
    "voxel_size": (".ply", ".pcd", ".bag", ".mcap", ".db3"),
    "topic": (".bag", ".mcap", ".db3"),
}
"""Endings whose readers take these keyword arguments."""
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
__all__ = ["BAGS", "EXPORTS", "FLAT", "IMPORTS", "export", "import_map", "read_octomap"]


def export(
    voxel_map: VoxelMap, path: str | Path, heights: tuple[float, float] | None = None, inflate: float | None = None
) -> None:
    """Write a map in the format that the file name's ending selects; a failed export leaves an older file intact.

    Cells that are not cubes are resampled to cubes where the format knows only those.

    Args:
        voxel_map: The map.
        path: File to write; `EXPORTS` lists the endings.
        heights: For 2-D maps and bags: lowest and highest metres that mark cells (see `projection.project`).
        inflate: For 2-D maps: robot radius in metres by which obstacles grow (see `projection.inflated_grid`).

    Raises:
        StereovoxError: Unknown ending, unwritable place, cells that the format cannot hold, or `heights` or `inflate`
            where they have no meaning.
    """
    ending = Path(path).suffix.lower()
    known = registry.names("export", EXPORTS)
    if ending not in known:
        raise StereovoxError(f"{path}: cannot export to '{ending}'; end the file's name with one of {', '.join(known)}")
    if heights is not None and ending not in (*FLAT, *BAGS):
        known = " or ".join((*FLAT, *BAGS))
        raise StereovoxError(f"{path}: heights are for 2-D maps alone; end the file's name with {known}")
    if inflate is not None and ending not in FLAT:
        raise StereovoxError(f"{path}: only 2-D maps are inflated; end the file's name with {' or '.join(FLAT)}")
    options = {"heights": heights, "inflate": inflate}
    given = {name: value for name, value in options.items() if value is not None}
    write = registry.find("export", EXPORTS, ending)
    write(voxel_map if ending in FLAT else in_cubes(voxel_map), path, **given)


def import_map(path: str | Path, voxel_size: float | None = None, topic: str | None = None) -> VoxelMap:
    """Read a map from another program's file, or from one that `export` wrote.

    `.bt`, `.ot`: OctoMap's cells. `.npz`: ours, exactly. `.ply`, `.pcd`: each cell that holds a point is occupied, all
    others are unknown. `.bag`, `.mcap`, `.db3` or a rosbag2 folder: the last Octomap, or PointCloud2, of a topic.

    Args:
        path: File or rosbag2 folder.
        voxel_size: Metres, for points from other programs; our own files declare it.
        topic: Topic in a bag (see `bags.read_bag_map`).

    Returns:
        The map.

    Raises:
        StereovoxError: What is wrong with the file, or an option that this kind of file does not take.
    """
    ending = ".mcap" if Path(path).is_dir() else Path(path).suffix.lower()
    known = registry.names("import", IMPORTS)
    if ending not in known:
        raise StereovoxError(f"{path}: cannot import '{ending}'; the file's name ends in one of {', '.join(known)}")
    options = {"voxel_size": voxel_size, "topic": topic}
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if ending not in OPTIONS[name]:
            option = f"--{name.replace('_', '-')}"
            raise StereovoxError(f"{path}: {option} says nothing about a '{ending}'; leave it out")
    return registry.find("import", IMPORTS, ending)(path, **given)
