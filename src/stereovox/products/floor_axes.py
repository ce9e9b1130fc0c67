# SPDX-License-Identifier: Apache-2.0
"""Heights and floors of maps whose `up` is any axis.

One layer of a map's cells, and its cells along a ray (Chien 2020, Fig 4.6 and 4.9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.storage.blocks import SIDE

MAX_CELLS = 2**30
"""Cells of the largest grid."""
MAX_TILT = np.radians(10.0)
"""Largest angle between a map's layers and the floor."""
Heights = tuple[float, float]
"""Lowest and highest metres above the floor."""


def floor_axes(up: str) -> tuple[int, int, int, int]:
    """Return the map axes that are x and y of its floor, the axis normal to the floor, and the sign of the latter along
    `up`.

    x and y are the map's if z is up; else the two axes that make a right-handed frame with `up`: y and z for x, z
    and x for y, and with a minus the same two swapped.
    """
    upright = "xyz".index(up[-1])
    x, y = (upright + 1) % 3, (upright + 2) % 3
    return (y, x, upright, -1) if up.startswith("-") else (x, y, upright, 1)


def upright_axes(up: str) -> NDArray[np.float64]:
    """Return rows (3, 3) x, y and z of a right-handed frame whose z is a map's `up`, as directions in the map's frame.

    These are the axes of the grid from `projection.project`.
    """
    x, y, upright, sign = floor_axes(up)
    unit = np.eye(3)
    return np.stack([unit[x], unit[y], sign * unit[upright]])


def up_of(config: Config) -> NDArray[np.float64]:
    """Return the unit vector (3,) that points up in the world of a map with these settings."""
    return upright_axes(config.up)[2] if config.up_direction is None else np.array(config.up_direction)


def nearest_axis(direction: NDArray[np.float64]) -> str:
    """Return the axis (`z`, `-y`, ...) that is nearest to a direction (3,)."""
    k = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[k] < 0 else ''}{'xyz'[k]}"


def heights_of(points: ArrayLike, up: str) -> NDArray[np.float64]:
    """Return the heights (N,) in metres of points (N, 3)."""
    _, _, upright, sign = floor_axes(up)
    return np.asarray(points, float)[:, upright] * sign


def checked_heights(heights: Heights) -> Heights:
    """Validate two heights; raises StereovoxError if they do not ascend."""
    low, high = heights
    if not low < high:
        raise StereovoxError(f"heights {low:g}:{high:g} must be two numbers that rise, LO:HI in metres")
    return low, high


def checked_band(heights: Heights) -> Heights:
    """Validate two heights above the floor; raises StereovoxError if they do not ascend from 0 or more."""
    low, high = heights
    if not (0 <= low < high < np.inf):
        raise StereovoxError(
            f"heights {low:g}:{high:g} must be two numbers that rise, LO:HI in metres above the floor, 0 or more"
        )
    return low, high


def check_level(config: Config) -> None:
    """Raise StereovoxError if the layers of a map are too far from level to show a floor."""
    if config.tilt > MAX_TILT:
        tilt = f"{np.degrees(config.tilt):.0f} degrees off {config.up}"
        raise StereovoxError(f"up is {tilt}, so no layer of the map is level; map the recording again with --level")


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
