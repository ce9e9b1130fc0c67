# SPDX-License-Identifier: Apache-2.0
"""A grid on disk, exactly: one `.npz` file with the tiles and, as JSON, the settings and counts."""

from __future__ import annotations

import io
import json
import math
import os
import uuid
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.config import load_config
from stereovox.errors import MapFileError, one_line
from stereovox.maps.grid_evidence import CELLS
from stereovox.untrusted import count_in, json_value

if TYPE_CHECKING:
    from stereovox.maps.grid_map import GridMap

FORMAT, VERSION = "stereovox-grid", 1
PARTS = ("about.npy", "coords.npy", "cells.npy")
SMALL, PACKED_BEST = 1 << 26, 200
"""A file may unpack to so many bytes, or to so many for each of its own; more is taken for a lie."""


def save_grid(grid_map: GridMap, path: str | Path) -> None:
    """Write `grid_map` to the file `path`, all or nothing. Raises MapFileError, one line, where that cannot be."""
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}.new")
    coords, cells = grid_map.tiles()
    about = np.frombuffer(json.dumps(_about(grid_map)).encode(), np.uint8)
    try:
        if target.is_dir():
            raise MapFileError(f"{path}: is a folder; name a file")
        with temporary.open("xb") as file:
            np.savez_compressed(file, about=about, coords=coords, cells=cells)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapFileError(f"{path}: cannot save the grid ({reason}); choose a writable folder") from None
    finally:
        if temporary.exists():
            temporary.unlink()


def load_grid(path: str | Path) -> GridMap:
    """Read a grid saved by `GridMap.save`. Raises MapFileError: one line with the file and what is wrong."""
    from stereovox.maps.grid_map import GridMap

    try:
        parts = _read(Path(path))
        about = json_value(parts["about"].tobytes())
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise ValueError(f"format {about['format']} {about['version']}, not {FORMAT} {VERSION}")
        grid_map = GridMap(load_config(about["config"]), about["origin"])
        grid_map.frames, grid_map.frames_refused = (count_in(about, key) for key in ("frames", "frames_refused"))
        grid_map.recording = one_line(str(about["recording"]))
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
        "frames": grid_map.frames,
        "frames_refused": grid_map.frames_refused,
        "recording": grid_map.recording,
        "config": grid_map.config.model_dump(),
    }


def _read(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as file:
        sizes = {entry.filename: entry.file_size for entry in file.infolist()}
        kinds = {entry.compress_type for entry in file.infolist()}
        if len(file.infolist()) != len(PARTS) or sorted(sizes) != sorted(PARTS):
            raise MapFileError(f"{path}: holds no grid; make one with GridMap.save")
        if not kinds <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise ValueError("packed in a way that is not used here")
        if sum(sizes.values()) > max(SMALL, PACKED_BEST * path.stat().st_size):
            raise ValueError(f"unpacks to {sum(sizes.values())} bytes")
        return {name.removesuffix(".npy"): _array(file, name, sizes[name]) for name in PARTS}


def _array(file: zipfile.ZipFile, name: str, size: int) -> np.ndarray:
    """Return an array of a file whose entry has `size` bytes unpacked; nothing is allocated for a shape that lies."""
    with file.open(name) as entry:
        data = entry.read(size)
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    shape, _, dtype = getattr(np.lib.format, f"read_array_header_{version[0]}_{version[1]}")(stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"{name} tells of {shape} {dtype} and holds {len(data) - stream.tell()} bytes")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape)
