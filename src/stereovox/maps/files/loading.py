# SPDX-License-Identifier: Apache-2.0
"""Opens saved maps: maps in one piece are read, maps in boxes are opened and read on demand."""

from __future__ import annotations

from pathlib import Path

from stereovox.files.places import Place, is_url
from stereovox.maps.boxed_map import BoxedMap
from stereovox.maps.files.boxed_manifest import read_boxed_manifest
from stereovox.maps.files.store import is_boxed, read_map
from stereovox.maps.storage.boxed_storage import CACHE_BYTES
from stereovox.maps.voxel_map import VoxelMap


def load_map(path: str | Path, *, cache_bytes: int = CACHE_BYTES) -> VoxelMap:
    """Read a whole map saved by `VoxelMap.save`, whatever window it was made in; or open a map in boxes.

    A map in boxes (`save_boxed`) is not loaded: each query reads the boxes it needs.

    Args:
        path: The folder of the map, or its URL in an object store (`s3://bucket/city.svox`).
        cache_bytes: Memory for the cells of a map in boxes; other maps take what they need.

    Returns:
        The map, without bounds, in memory; or a `BoxedMap`.

    Raises:
        MapFileError: One line with the file and what is wrong with it.
        MissingExtra: A URL is given, and obstore is not installed.
    """
    if is_url(path) or is_boxed(path):
        place = Place.of(path)
        return BoxedMap(place, read_boxed_manifest(place), cache_bytes)
    saved = read_map(path)
    voxel_map = VoxelMap(saved.config)
    storage = voxel_map.storage
    storage.history, storage.viewpoint, storage.window_state = saved.history, saved.viewpoint, saved.window_state
    storage.insert(saved.coords, saved.cells)
    storage.kept = saved.kept
    if saved.times is not None:
        storage.set_times(saved.coords, saved.times, saved.times_start_ns)
    return voxel_map
