# SPDX-License-Identifier: Apache-2.0
"""A grid on disk, exactly: one `.npz` file with the tiles and, as JSON, the settings and counts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.files import replacing
from stereovox.history import History
from stereovox.maps.arrays_file import read_arrays
from stereovox.maps.grid_evidence import CELLS
from stereovox.maps.lock import only_writer_of
from stereovox.untrusted import json_value

if TYPE_CHECKING:
    from stereovox.maps.grid_map import GridMap

FORMAT, VERSION = "stereovox-grid", 1
PARTS = ("about", "coords", "cells")


def save_grid(grid_map: GridMap, path: str | Path) -> None:
    """Write `grid_map` to the file `path`, all or nothing.

    Raises MapFileError, one line, where that cannot be or another run is writing it.
    """
    coords, cells = grid_map.tiles()
    about = np.frombuffer(json.dumps(_about(grid_map)).encode(), np.uint8)
    with only_writer_of(Path(path)), replacing(path) as file:
        np.savez_compressed(file, about=about, coords=coords, cells=cells)


def load_grid(path: str | Path) -> GridMap:
    """Read a grid saved by `GridMap.save`. Raises MapFileError: one line with the file and what is wrong."""
    from stereovox.maps.grid_map import GridMap

    try:
        parts = read_arrays(path, PARTS, "grid; make one with GridMap.save")
        about = json_value(parts["about"].tobytes())
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise ValueError(f"format {about['format']} {about['version']}, not {FORMAT} {VERSION}")
        grid_map = GridMap(load_config(about["config"]), about["origin"])
        grid_map.history = History.loaded(about)
        coords, cells = parts["coords"], parts["cells"]
        wanted = ((len(coords), 3), np.int32), ((len(coords), CELLS), grid_map.cell_format.dtype)
        for array, (shape, dtype) in zip((coords, cells), wanted, strict=True):
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(f"array of {array.shape} {array.dtype} where {shape} {np.dtype(dtype)} belongs")
        if not np.isfinite(grid_map.origin).all() or coords[:, 2].any() or (np.abs(coords) > 1 << 24).any():
            raise ValueError("tiles or origin out of range")
        if not (cells != grid_map.cell_format.unknown).any(axis=1).all():
            raise ValueError("a tile without a known cell")
        grid_map.insert(coords, cells)
    except MapFileError:
        raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception as error:  # what a damaged file can raise in zipfile, zlib, NumPy and JSON is not bounded
        why = " ".join(str(error).split()) or type(error).__name__
        raise MapFileError(f"{path}: no grid that can be read ({why}); save it anew") from None
    return grid_map


def _about(grid_map: GridMap) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "origin": grid_map.origin.tolist(),
        **grid_map.history.saved(),
        "config": grid_map.config.model_dump(),
    }
