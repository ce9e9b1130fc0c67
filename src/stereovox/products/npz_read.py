# SPDX-License-Identifier: Apache-2.0
"""Read the `.npz` that `points.write_npz` wrote: the same cells, the same settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.maps import VoxelMap
from stereovox.maps.arrays_file import read_arrays
from stereovox.maps.queries import INDEX_LIMIT
from stereovox.products.cloud_cells import check_room
from stereovox.untrusted import json_value

ARRAYS = ("indices", "log_odds", "voxel_size", "free_below", "occupied_above", "settings")


def read_npz(path: str | Path) -> VoxelMap:
    """Return the map in a `.npz` of ours, cell for cell; what it remembered of its frames is not in such a file.

    Raises MapFileError: one line with the file and what is wrong.
    """
    try:
        arrays = read_arrays(path, ARRAYS, "cells of a map; write them with stereovox export")
        settings = json_value(arrays["settings"].astype(np.uint8, casting="safe").tobytes())
        if not isinstance(settings, dict):
            raise ValueError("settings is no table")
        indices, log_odds = _checked(arrays["indices"], arrays["log_odds"])
        return VoxelMap.from_cells(load_config(settings), indices, log_odds)
    except MapFileError:
        raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of cells") from None
    except Exception as error:  # what a damaged file can raise in zipfile, zlib and NumPy is not bounded
        why = " ".join(str(error).split()) or type(error).__name__
        raise MapFileError(f"{path}: no cells that can be read ({why}); export them again") from None


def _checked(indices: NDArray[np.integer], log_odds: NDArray[np.floating]) -> tuple[NDArray, NDArray]:
    if indices.dtype != np.int32 or indices.shape != (len(indices), 3):
        raise ValueError(f"indices are {indices.shape} {indices.dtype}, not (N, 3) int32")
    if log_odds.dtype != np.float32 or log_odds.shape != (len(indices),):
        raise ValueError(f"log_odds are {log_odds.shape} {log_odds.dtype}, not ({len(indices)},) float32")
    if not np.isfinite(log_odds).all() or (np.abs(indices.astype(np.int64)) >= INDEX_LIMIT).any():
        raise ValueError("a cell out of range")
    check_room(indices)
    return indices, log_odds
