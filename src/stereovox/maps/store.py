# SPDX-License-Identifier: Apache-2.0
"""A map on disk: a folder with a manifest (JSON) and the cells as Zarr v3 arrays.

Zarr writes are not transactional, so each save goes to a folder of its own and becomes the map when the manifest
that names it is renamed into place; only then is the older save removed. A killed save leaves the older map whole.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.errors import ConfigError, MapFileError
from stereovox.maps.blocks import CELLS

if TYPE_CHECKING:
    from stereovox.maps.voxel_map import VoxelMap

FORMAT = "stereovox-map"
VERSION = 1
MANIFEST = "manifest.json"
BLOCKS_PER_CHUNK = 4096


def save_map(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write `voxel_map` to the folder `path`. Raises MapFileError when it cannot be written or is no map."""
    folder = Path(path)
    check_target(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        data = f"cells-{uuid.uuid4().hex[:12]}"
        coords, cells = voxel_map.blocks()
        _write_arrays(folder / data, {"coords": coords, "cells": cells})
        _write_manifest(folder, _manifest(voxel_map, data, len(coords), _checksum(coords, cells)))
    except OSError as error:
        raise MapFileError(
            f"{folder}: cannot save the map ({error.strerror or error}); choose a writable folder"
        ) from None
    for old in folder.glob("cells-*"):
        if old.name != data:
            shutil.rmtree(old, ignore_errors=True)


def check_target(folder: Path) -> None:
    """Raise MapFileError when a map cannot be saved to `folder`: it holds something else or cannot be written."""
    if folder.exists() and not is_map(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise MapFileError(f"{folder}: exists and is not a stereovox map; choose another name or remove it")
    there = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise MapFileError(f"{folder}: {there} cannot be written to; choose a writable folder")


def load_map(path: str | Path) -> VoxelMap:
    """Read a map saved by `VoxelMap.save`. Raises MapFileError: one line with the file and what is wrong."""
    from stereovox.maps.voxel_map import VoxelMap

    folder = Path(path)
    manifest = read_manifest(folder)
    try:
        voxel_map = VoxelMap(load_config(manifest["config"]))
        voxel_map.frames, voxel_map.frames_refused = int(manifest["frames"]), int(manifest["frames_refused"])
        voxel_map.recording = str(manifest["recording"])
        coords, cells = _read_arrays(folder / str(manifest["data"]), int(manifest["blocks"]))
        if _checksum(coords, cells) != manifest["checksum"]:
            raise ValueError("the cells do not match their checksum")
    except (KeyError, TypeError, ValueError, OSError, RuntimeError, ConfigError) as error:
        raise MapFileError(f"{folder}: damaged map ({type(error).__name__}: {error}); make it anew") from None
    voxel_map._pool.insert(coords)
    voxel_map._pool.values[: len(cells)] = np.clip(cells, voxel_map._lowest, voxel_map._highest)
    voxel_map._match_flags()
    return voxel_map


def is_map(path: str | Path) -> bool:
    """Tell whether a folder holds a saved map."""
    return (Path(path) / MANIFEST).is_file()


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a saved map: format, version, config, frames, data, blocks."""
    if not is_map(folder):
        raise MapFileError(
            f"{folder}: no stereovox map here (no {MANIFEST}); make one with: stereovox map SOURCE --out {folder}"
        )
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
    except (OSError, ValueError) as error:
        raise MapFileError(f"{folder / MANIFEST}: cannot be read ({error}); make the map anew") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise MapFileError(f"{folder / MANIFEST}: not a stereovox map")
    if manifest.get("version") != VERSION:
        raise MapFileError(
            f"{folder}: map format {manifest.get('version')}, this program reads {VERSION}; update stereovox"
        )
    if "/" in str(manifest.get("data")) or ".." in str(manifest.get("data")):
        raise MapFileError(f"{folder / MANIFEST}: data '{manifest['data']}' points outside the map")
    return manifest


def _manifest(voxel_map: VoxelMap, data: str, blocks: int, checksum: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "frames": voxel_map.frames,
        "frames_refused": voxel_map.frames_refused,
        "recording": voxel_map.recording,
        "blocks": blocks,
        "data": data,
        "checksum": checksum,
        "config": voxel_map.config.model_dump(),
    }


def _checksum(*arrays: NDArray) -> int:
    """Zarr reads a chunk whose file is gone as empty cells; this number tells."""
    checksum = 0
    for array in arrays:
        checksum = zlib.crc32(np.ascontiguousarray(array).tobytes(), checksum)
    return checksum


def _write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    temporary = folder / f".{MANIFEST}.new"
    with temporary.open("w") as file:
        json.dump(manifest, file, indent=2)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(folder / MANIFEST)


def _write_arrays(folder: Path, arrays: dict[str, NDArray]) -> None:
    import zarr

    group = zarr.open_group(folder, mode="w", zarr_format=3)
    for name, array in arrays.items():
        rows = max(1, min(BLOCKS_PER_CHUNK, len(array)))
        stored = group.create_array(
            name, shape=array.shape, dtype=array.dtype, chunks=(rows, array.shape[1]), fill_value=0
        )
        if len(array):
            stored[:] = array


def _read_arrays(folder: Path, blocks: int) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    import zarr

    group = zarr.open_group(folder, mode="r")
    coords: Any = group["coords"]
    cells: Any = group["cells"]
    for array, shape, dtype in ((coords, (blocks, 3), np.int32), (cells, (blocks, CELLS), np.int16)):
        if array.shape != shape or array.dtype != dtype:
            raise ValueError(f"array of {array.shape} {array.dtype} where {shape} {np.dtype(dtype)} belongs")
    return np.asarray(coords[:]), np.asarray(cells[:])
