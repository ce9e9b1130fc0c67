# SPDX-License-Identifier: Apache-2.0
"""What a map becomes for other programs: one writer a file type, chosen by the file's ending."""

from __future__ import annotations

from pathlib import Path

from stereovox import registry
from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.maps.cubes import in_cubes
from stereovox.products.octomap_read import read_octomap

EXPORTS = {
    ".bt": "stereovox.products.octomap_write:write_bt",
    ".ot": "stereovox.products.octomap_write:write_ot",
    ".ply": "stereovox.products.points:write_ply",
    ".pcd": "stereovox.products.points:write_pcd",
    ".npz": "stereovox.products.points:write_npz",
    ".glb": "stereovox.products.meshes:write_glb",
    ".obj": "stereovox.products.meshes:write_obj",
    ".stl": "stereovox.products.meshes:write_stl",
    ".bag": "stereovox.products.bag_maps:write_bag",
    ".mcap": "stereovox.products.bag_maps:write_bag",
    ".db3": "stereovox.products.bag_maps:write_bag",
    ".rrd": "stereovox.products.rerun_write:write_rrd",
    ".pgm": "stereovox.products.map_server:write_grid",
    ".png": "stereovox.products.map_server:write_grid",
    ".yaml": "stereovox.products.map_server:write_grid",
}
"""File ending -> writer `(voxel_map, path) -> None`; other packages add theirs as entry points `stereovox.export`."""
FLAT = (".pgm", ".png", ".yaml")
"""Endings of 2-D maps, whose writer takes `heights` and `inflate` too."""
BAGS = (".bag", ".mcap", ".db3")
"""Endings of recordings of ROS, with a 2-D map in them, whose writer takes `heights` too."""

__all__ = ["BAGS", "EXPORTS", "FLAT", "export", "read_octomap"]


def export(
    voxel_map: VoxelMap, path: str | Path, heights: tuple[float, float] | None = None, inflate: float | None = None
) -> None:
    """Write `voxel_map` to the file `path` in the format its ending names; a failed export leaves an older file whole.

    Uneven cells become cubes where the format knows only those.
    heights: for 2-D maps and bags, the lowest and highest metres that mark cells (see `projection.project`).
    inflate: for 2-D maps, a robot's radius in metres by which obstacles grow (see `inflate.inflated_grid`).
    Raises StereovoxError: one line about an unknown ending, a place that cannot be written, cells the format cannot
    hold, or heights or inflation where they have no meaning.
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
