# SPDX-License-Identifier: Apache-2.0
"""What a map becomes for other programs: one writer a file type, chosen by the file's ending."""

from __future__ import annotations

from pathlib import Path

from stereovox import registry
from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.products.octomap_read import read_octomap

EXPORTS = {
    ".bt": "stereovox.products.octomap_write:write_bt",
    ".ot": "stereovox.products.octomap_write:write_ot",
    ".ply": "stereovox.products.points:write_ply",
    ".npz": "stereovox.products.points:write_npz",
    ".rrd": "stereovox.products.rerun_write:write_rrd",
    ".pgm": "stereovox.products.projection:write_grid",
    ".png": "stereovox.products.projection:write_grid",
    ".yaml": "stereovox.products.projection:write_grid",
}
"""File ending -> writer `(voxel_map, path) -> None`; other packages add theirs as entry points `stereovox.export`."""
FLAT = (".pgm", ".png", ".yaml")
"""Endings of 2-D maps, whose writer takes `heights` too."""

__all__ = ["EXPORTS", "FLAT", "export", "read_octomap"]


def export(voxel_map: VoxelMap, path: str | Path, heights: tuple[float, float] | None = None) -> None:
    """Write `voxel_map` to the file `path` in the format its ending names; a failed export leaves an older file whole.

    heights: for 2-D maps, the lowest and highest metres that mark cells (see `projection.project`).
    Raises StereovoxError: one line about an unknown ending, a place that cannot be written, cells the format cannot
    hold, or heights where they have no meaning.
    """
    ending = Path(path).suffix.lower()
    known = registry.names("export", EXPORTS)
    if ending not in known:
        raise StereovoxError(f"{path}: cannot export to '{ending}'; end the file's name with one of {', '.join(known)}")
    if heights is not None and ending not in FLAT:
        raise StereovoxError(f"{path}: heights are for 2-D maps alone; end the file's name with {' or '.join(FLAT)}")
    registry.find("export", EXPORTS, ending)(voxel_map, path, *([] if heights is None else [heights]))
