# SPDX-License-Identifier: Apache-2.0
"""One layer of a map's cells, and its cells along a ray (Chien 2020, Fig 4.6 and 4.9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.storage.blocks import SIDE

ACROSS = {"x": ("y", "z"), "y": ("x", "z"), "z": ("x", "y")}
"""For the normal axis of a layer: the axes of its columns and of its rows."""


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of cells.

    log_odds: (rows, columns) float32, NaN if unknown; state: (rows, columns) uint8 of `State`; row 0 and column 0
    are the lowest. extent: left, right, bottom, top in metres. axes: names of the axes of columns and rows. at_m:
    position of the layer's middle on its axis `across`.
    """

    log_odds: NDArray[np.float32]
    state: NDArray[np.uint8]
    extent: tuple[float, float, float, float]
    axes: tuple[str, str]
    across: str
    at_m: float


@one_state
def layer(voxel_map: VoxelMap, across: str, at_m: float, bounds: NDArray[np.float64] | None = None) -> Layer:
    """Return the layer that contains the plane `across` = `at_m` metres, as large as the map's known cells.

    bounds: `voxel_map.bounds()`, if the caller has it already: it takes longer than the rest.
    Raises StereovoxError if `across` is none of x, y, z, `at_m` is no number, or the map is empty.
    """
    if across not in ACROSS:
        raise StereovoxError(f"layer across '{across}': name one of x, y, z")
    if not np.isfinite(at_m):
        raise StereovoxError(f"layer at {at_m}: give a place in metres")
    bounds = voxel_map.bounds() if bounds is None else bounds
    if bounds is None:
        raise StereovoxError("the map is empty: there is no layer to show")
    size = voxel_map.voxel_size
    normal, columns, rows = ("xyz".index(name) for name in (across, *ACROSS[across]))
    (left, bottom), (right, top) = np.rint(bounds[:, [columns, rows]] / size).astype(int).tolist()
    number = int(np.floor(at_m / size))
    stored = _stored(voxel_map, number, (normal, columns, rows), (left >> 3, bottom >> 3, right >> 3, top >> 3))
    row, column = bottom & 7, left & 7
    stored = stored[row : row + top - bottom, column : column + right - left]
    known = stored != voxel_map.storage.cell_format.unknown
    log_odds = np.where(known, voxel_map.storage.cell_format.log_odds(stored), np.float32(np.nan))
    extent = (left * size, right * size, bottom * size, top * size)
    return Layer(
        log_odds, CellRules(voxel_map.config.map).states(stored), extent, ACROSS[across], across, (number + 0.5) * size
    )


def along_ray(
    voxel_map: VoxelMap, origin: ArrayLike, direction: ArrayLike, length_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the cells along a ray: distance (N + 1,) in metres of each cell's entry, and of the end; log-odds (N,).

    origin (3,) in metres, direction (3,) of any length but zero, world frame. Log-odds are 0 if unknown.
    """
    start, towards = np.asarray(origin, float), np.asarray(direction, float)
    if not np.linalg.norm(towards) > 0:
        raise StereovoxError(f"direction {towards.tolist()} points nowhere")
    towards = towards / np.linalg.norm(towards)
    cuts = [np.array([0.0, length_m])]
    for s, t in zip(start / voxel_map.voxel_size, towards / voxel_map.voxel_size, strict=True):
        if t != 0:
            first, last = sorted((s, s + t * length_m))
            cuts.append((np.arange(np.ceil(first), np.floor(last) + 1) - s) / t)
    distance = np.unique(np.concatenate(cuts).clip(0, length_m))
    distance = distance[np.append(True, np.diff(distance) > 1e-9)]
    middle = (distance[:-1] + distance[1:]) / 2
    return distance, voxel_map.log_odds(start + middle[:, None] * towards)


def _stored(
    voxel_map: VoxelMap, number: int, axes: tuple[int, int, int], blocks: tuple[int, int, int, int]
) -> NDArray[np.integer]:
    """Return the cells (rows, columns) as stored of layer `number`, of the blocks left, bottom, right, top."""
    normal, columns, rows = axes
    low, high = np.array(blocks).reshape(2, 2)
    cell_format = voxel_map.storage.cell_format
    across, up = (high - low + 1).tolist()
    shape = (up, SIDE, across, SIDE)
    found = np.full(shape, cell_format.unknown, cell_format.dtype)
    for coords, cells in voxel_map.storage.slabs():
        place = coords[:, [columns, rows]]
        here = (coords[:, normal] == number >> 3) & (place >= low).all(axis=1) & (place <= high).all(axis=1)
        column, row = (place[here] - low).T
        cubes = np.moveaxis(cells[here].reshape(-1, SIDE, SIDE, SIDE), 1 + normal, 1)
        found[row, :, column] = cubes[:, number & 7].swapaxes(1, 2)  # a block's lower axis is first: the columns
    return found.reshape(shape[0] * SIDE, -1)
