# SPDX-License-Identifier: Apache-2.0
"""Read a map for a comparison, whoever made it."""

from __future__ import annotations

from pathlib import Path

from stereovox.maps import VoxelMap, load_map


def read_map(path: str | Path) -> VoxelMap:
    """Return the map in a stereovox folder or in an OctoMap file (`.bt`, `.ot`).

    Raises MapFileError: one line with the file and what is wrong.
    """
    if Path(path).suffix.lower() in (".bt", ".ot") and not Path(path).is_dir():
        from stereovox.products.octomap_read import read_octomap

        return read_octomap(path)
    return load_map(path)
