# SPDX-License-Identifier: Apache-2.0
"""Maps of other programs as maps of ours: one reader a file type, chosen by the file's ending."""

from __future__ import annotations

from pathlib import Path

from stereovox import registry
from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap

IMPORTS = {
    ".bt": "stereovox.products.octomap_read:read_octomap",
    ".ot": "stereovox.products.octomap_read:read_octomap",
    ".npz": "stereovox.products.npz_read:read_npz",
    ".ply": "stereovox.products.point_files:read_point_map",
    ".pcd": "stereovox.products.point_files:read_point_map",
    ".bag": "stereovox.products.bag_maps:read_bag_map",
    ".mcap": "stereovox.products.bag_maps:read_bag_map",
    ".db3": "stereovox.products.bag_maps:read_bag_map",
}
"""File ending -> reader `(path) -> VoxelMap`; other packages add theirs as entry points `stereovox.import`."""
TAKES = {
    "voxel_size": (".ply", ".pcd", ".bag", ".mcap", ".db3"),
    "topic": (".bag", ".mcap", ".db3"),
}
"""Which files' readers want to know more, by keyword."""


def import_map(path: str | Path, voxel_size: float | None = None, topic: str | None = None) -> VoxelMap:
    """Return the map in a file of another program, or in one that `export` wrote.

    `.bt`, `.ot`: OctoMap's cells. `.npz`: ours, exactly. `.ply`, `.pcd`: each cell that holds a point is occupied, all
    others are unknown. `.bag`, `.mcap`, `.db3` or a rosbag2 folder: the last Octomap, or PointCloud2, of a topic.
    voxel_size: metres, for points of other programs; ours tell it. topic: see `bag_maps.read_bag_map`.
    Raises StereovoxError: one line with the file and what is wrong, or an option that says nothing for such a file.
    """
    ending = ".mcap" if Path(path).is_dir() else Path(path).suffix.lower()
    known = registry.names("import", IMPORTS)
    if ending not in known:
        raise StereovoxError(f"{path}: cannot import '{ending}'; the file's name ends in one of {', '.join(known)}")
    told = {"voxel_size": voxel_size, "topic": topic}
    given = {name: value for name, value in told.items() if value is not None}
    for name in given:
        if ending not in TAKES[name]:
            option = f"--{name.replace('_', '-')}"
            raise StereovoxError(f"{path}: {option} says nothing about a '{ending}'; leave it out")
    return registry.find("import", IMPORTS, ending)(path, **given)
