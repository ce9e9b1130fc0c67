# SPDX-License-Identifier: Apache-2.0
"""Maps of points, and our `.npz`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config, load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.safe_io import json_value, read_arrays
from stereovox.maps import VoxelMap
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.storage.blocks import blocks_of_cells

MAX_BLOCKS = 2**19
"""Most blocks of 8x8x8 cells, 1 KB each, so that a file of distant points cannot fill the memory."""
MAX_RANGE_CELLS = 8000
"""Cells of the settings' range, which may span 8192."""
ARRAYS = ("indices", "log_odds", "voxel_size", "free_below", "occupied_above", "settings")


def read_npz(path: str | Path) -> VoxelMap:
    """Return the map in one of our `.npz`, cell for cell; the file does not contain the map's history.

    Raises MapFileError: one line with the file and the problem.
    """
    try:
        arrays = read_arrays(path, ARRAYS, "cells of a map; write them with stereovox export")
        settings = json_value(arrays["settings"].astype(np.uint8, casting="safe").tobytes())
        if not isinstance(settings, dict):
            raise ValueError("settings is not a table")
        indices, log_odds = _checked(arrays["indices"], arrays["log_odds"])
        return VoxelMap.from_cells(load_config(settings), indices, log_odds)
    except MapFileError:
        raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of cells") from None
    except Exception as error:  # a damaged file can raise anything in zipfile, zlib and NumPy
        why = " ".join(str(error).split()) or type(error).__name__
        raise MapFileError(f"{path}: no readable cells ({why}); export them again") from None


def cells_of_points(points: ArrayLike, voxel_size: float) -> VoxelMap:
    """Return a map of the default profile in which each cell that holds a point is occupied, all others unknown.

    points: (N, 3) metres, world frame; non-finite ones are ignored. voxel_size: metres. Raises StereovoxError
    for points too far away for any cell, for too many blocks, or a bad size.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    config = _config(voxel_size)
    cells = np.floor(points[np.isfinite(points).all(axis=1)] / voxel_size)
    if (np.abs(cells) >= INDEX_LIMIT).any():
        raise StereovoxError(
            f"a point is more than {INDEX_LIMIT * voxel_size:g} m away; check the unit, or use larger cells"
        )
    indices = cells.astype(np.int64)
    check_room(indices)
    return VoxelMap.from_cells(config, indices, np.full(len(indices), config.map.log_odds_max))


def _config(voxel_size: float) -> Config:
    """Return the default profile with a cell size, and a range within the limit on cells: these points have no
    range."""
    usual = load_config()
    deepest = voxel_size * MAX_RANGE_CELLS
    return load_config(voxel_size=voxel_size, max_range=deepest if 0 < deepest < usual.max_range else usual.max_range)


def check_room(indices: NDArray[np.integer]) -> None:
    """Raise StereovoxError if cells (N, 3) are in more than `MAX_BLOCKS` blocks."""
    blocks = len(blocks_of_cells(indices)[0]) if len(indices) > MAX_BLOCKS else len(indices)
    if blocks > MAX_BLOCKS:
        raise StereovoxError(f"its cells are in {blocks} blocks, more than {MAX_BLOCKS}; use larger cells or crop it")


def _checked(indices: NDArray[np.integer], log_odds: NDArray[np.floating]) -> tuple[NDArray, NDArray]:
    if indices.dtype != np.int32 or indices.shape != (len(indices), 3):
        raise ValueError(f"indices are {indices.shape} {indices.dtype}, not (N, 3) int32")
    if log_odds.dtype != np.float32 or log_odds.shape != (len(indices),):
        raise ValueError(f"log_odds are {log_odds.shape} {log_odds.dtype}, not ({len(indices)},) float32")
    if not np.isfinite(log_odds).all() or (np.abs(indices.astype(np.int64)) >= INDEX_LIMIT).any():
        raise ValueError("a cell out of range")
    check_room(indices)
    return indices, log_odds
