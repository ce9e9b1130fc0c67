# SPDX-License-Identifier: Apache-2.0
"""Maps as points: `.ply` and `.pcd` for point cloud programs, `.npz` for NumPy.

Maps of points, and our `.npz`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config, load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.safe_io import json_value, read_arrays, replacing
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.occupancy import Percent
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.storage.blocks import blocks_of_cells
from stereovox.products.floor_axes import heights_of

PLY_POINT = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"),
        ("probability", "<f4"),
    ]
)  # fmt: skip
PLY_TYPES = {"f": "float", "u": "uchar"}
PCD_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("probability", "<f4")])
HEIGHT_RAMP = ((40, 60, 180), (30, 160, 210), (70, 190, 90), (240, 200, 50), (200, 40, 30))
"""Red, green and blue at equal steps from the lowest to the highest point."""


@one_state
def write_ply(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the occupied cells as a binary point cloud: centre in metres (world frame), colour by height, probability.

    Raises MapFileError if the file cannot be written.
    """
    points, colours = _occupied(voxel_map, PLY_POINT)
    for channel, name in enumerate(("red", "green", "blue")):
        points[name] = colours[:, channel]
    _write(path, _ply_header(len(points), voxel_map.voxel_size), points)


@one_state
def write_pcd(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the occupied cells as PCL's binary point cloud, with the same fields as `write_ply`.

    Raises MapFileError if the file cannot be written.
    """
    points, colours = _occupied(voxel_map, PCD_POINT)
    points["rgb"] = colours.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    _write(path, _pcd_header(len(points), voxel_map.voxel_size), points)


def write_npz(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write every known cell for `numpy.load`, with the settings, so that `read_points.read_npz` restores the same
    cells.

    Arrays: `indices` (N, 3) int32, cell i covers [i, i + 1) * voxel_size; `log_odds` (N,) float32; and the numbers
    `voxel_size` in metres, `free_below` and `occupied_above` (probabilities). Cells not listed are unknown. `settings`
    (M,) uint8 is JSON. Raises MapFileError if the file cannot be written.
    """
    indices, log_odds = voxel_map.cells()
    percent = Percent(CellRules(voxel_map.config.map))
    with replacing(path) as file:
        np.savez_compressed(
            file,
            indices=indices,
            log_odds=log_odds,
            voxel_size=np.float64(voxel_map.voxel_size),
            free_below=np.float64(percent.free_below),
            occupied_above=np.float64(percent.occupied_above),
            settings=np.frombuffer(json.dumps(voxel_map.config.model_dump()).encode(), np.uint8),
        )


def cell_colours(voxel_map: VoxelMap, centers: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the `height_colours` (N, 3) of points (N, 3) in metres, whichever axis of the map is up."""
    return height_colours(heights_of(centers, voxel_map.config.up))


def height_colours(z: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return colours (N, 3) from blue at the lowest through green to red at the highest of the heights (N,)."""
    if not len(z):
        return np.zeros((0, 3), np.uint8)
    share = (z - z.min()) / max(float(np.ptp(z)), 1e-9)
    at = np.linspace(0, 1, len(HEIGHT_RAMP))
    return np.stack([np.interp(share, at, channel) for channel in np.transpose(HEIGHT_RAMP)], axis=1).astype(np.uint8)


def _occupied(voxel_map: VoxelMap, kind: np.dtype) -> tuple[NDArray[np.void], NDArray[np.uint8]]:
    """Return the occupied cells as records (N,) with their centres and probabilities, and their colours (N, 3)."""
    centers = voxel_map.occupied()
    points = np.empty(len(centers), kind)
    points["x"], points["y"], points["z"] = centers.T
    points["probability"] = voxel_map.probability(centers)
    return points, cell_colours(voxel_map, centers)


def _write(path: str | Path, header: str, points: NDArray[np.void]) -> None:
    with replacing(path) as file:
        file.write(header.encode("ascii"))
        file.write(points.tobytes())


def _ply_header(number: int, voxel_size: float) -> str:
    properties = [f"property {PLY_TYPES[PLY_POINT[name].kind]} {name}" for name in PLY_POINT.names or ()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_format_voxel_size(voxel_size)}",
        f"element vertex {number}",
        *properties,
        "end_header",
    ]
    return "\n".join([*lines, ""])


def _pcd_header(number: int, voxel_size: float) -> str:
    names = PCD_POINT.names or ()
    lines = [
        f"# {_format_voxel_size(voxel_size)}",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(PCD_POINT[name].itemsize) for name in names)}",
        f"TYPE {' '.join(PCD_POINT[name].kind.upper() for name in names)}",
        f"COUNT {' '.join('1' * len(names))}",
        f"WIDTH {number}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {number}",
        "DATA binary",
    ]
    return "\n".join([*lines, ""])


def _format_voxel_size(voxel_size: float) -> str:
    """Return the comment from which `read_points` reads the size of a cell."""
    return f"centres of occupied cells of {voxel_size!r} m"


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
