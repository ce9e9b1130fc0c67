# SPDX-License-Identifier: Apache-2.0
"""Read a map for a comparison, whoever made it."""

from __future__ import annotations

from pathlib import Path

from stereovox.errors import MapFileError
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.store import is_map


def read_map(path: str | Path) -> VoxelMap:
    """Return the map in a stereovox folder or in an OctoMap file (`.bt`, `.ot`).

    Raises MapFileError: one line with the file and what is wrong.
    """
    from stereovox.sources import is_recording

    if Path(path).suffix.lower() in (".bt", ".ot") and not Path(path).is_dir():
        from stereovox.products.octomap_read import read_octomap

        return read_octomap(path)
    if not is_map(path) and is_recording(path):
        cure = f"make a map of it with 'stereovox map', or the truth with 'stereovox truth {path} --out truth.svox'"
        raise MapFileError(f"{path}: is a recording, no map; {cure}")
    return load_map(path)
