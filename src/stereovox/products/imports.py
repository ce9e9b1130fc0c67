# SPDX-License-Identifier: Apache-2.0
"""Maps of other programs as maps of ours: one reader a file type, chosen by the file's ending."""

from __future__ import annotations

from pathlib import Path

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.products.bag_maps import read_bag_map
from stereovox.products.npz_read import read_npz
from stereovox.products.octomap_read import read_octomap
from stereovox.products.point_files import read_point_map

WHOLE = {".bt": read_octomap, ".ot": read_octomap, ".npz": read_npz}
"""Files that tell all by themselves."""
POINTS = (".ply", ".pcd")
BAGS = (".bag", ".mcap", ".db3")
ENDINGS = (*WHOLE, *POINTS, *BAGS)


def import_map(path: str | Path, voxel_size: float | None = None, topic: str | None = None) -> VoxelMap:
    """Return the map in a file of another program, or in one that `export` wrote.

    `.bt`, `.ot`: OctoMap's cells. `.npz`: ours, exactly. `.ply`, `.pcd`: each cell that holds a point is occupied, all
    others are unknown. `.bag`, `.mcap`, `.db3` or a rosbag2 folder: the last Octomap, or PointCloud2, of a topic.
    voxel_size: metres, for points of other programs; ours tell it. topic: see `bag_maps.read_bag_map`.
    Raises StereovoxError: one line with the file and what is wrong, or an option that says nothing for such a file.
    """
    ending = Path(path).suffix.lower()
    bag = ending in BAGS or Path(path).is_dir()
    if not bag and ending not in ENDINGS:
        raise StereovoxError(f"{path}: cannot import '{ending}'; the file's name ends in one of {', '.join(ENDINGS)}")
    if voxel_size is not None and ending in WHOLE:
        raise StereovoxError(f"{path}: tells itself how large its cells are; leave --voxel-size out")
    if topic is not None and not bag:
        raise StereovoxError(f"{path}: has no topics; leave --topic out")
    if bag:
        return read_bag_map(path, voxel_size, topic)
    return read_point_map(path, voxel_size) if ending in POINTS else WHOLE[ending](path)
