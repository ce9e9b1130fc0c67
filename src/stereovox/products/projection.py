# SPDX-License-Identifier: Apache-2.0
"""A 3-D map seen from above: the 2-D grid a ground robot plans in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.guarded import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.blocks import SIDE
from stereovox.maps.cell_format import CellRules
from stereovox.maps.cubes import in_cubes
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.percent import Percent
from stereovox.products import _projection
from stereovox.products.floor_axes import Heights, floor_axes

NOTHING = np.iinfo(np.int16).min
"""What a column is stored as of which nothing is known; no cell is stored so."""
MOST_CELLS = 2**30
"""Cells of the largest grid."""
TIE = 1e-9


class Patch(NamedTuple):
    """Some blocks seen from above: lowest column and row, and (rows, columns) int16 as `look_down` fills them."""

    corner: NDArray[np.int64]
    marked: NDArray[np.int16]
    cleared: NDArray[np.int16]


@one_state
def project(voxel_map: VoxelMap, heights: Heights | None = None) -> OccupancyGrid:
    """Return the map seen from above, just large enough for what is known.

    heights: lowest and highest metres along the map's `up`, from the world's origin; a cell whose middle is between
    them marks. Without it those of the map's own `scan.heights`.
    The heights are for marking alone. A column has the largest probability of all its known cells between them: one
    that is occupied makes it occupied (a table top is not thicker), one that is neither keeps it from being free. Where
    nothing between them is known, free cells at any other height clear it, and it has the largest probability of those.
    Else it is unknown.
    The grid's x and y are the map's, where z is up; else the two axes that make a right-handed frame with `up`: y and z
    for x, z and x for y, and with a minus the same two swapped. Uneven cells become cubes where the floor needs it.
    Raises StereovoxError, one line, where no cell between the heights is known, or the grid were too large.
    """
    order = list(floor_axes(voxel_map.config.up)[:3])
    if voxel_map.config.cell[order[0]] != voxel_map.config.cell[order[1]]:
        voxel_map = in_cubes(voxel_map)
    heights = heights or voxel_map.config.scan.heights
    layers = layers_of(voxel_map, order[2], heights)
    patches = [patch_of(voxel_map, *slab, order, layers) for slab in voxel_map.slabs() if len(slab[0])]
    patch = _joined(patches)
    if patch is None or not (patch.marked != NOTHING).any():
        raise StereovoxError(_nothing_there(voxel_map, order[2], heights))
    return _grid(voxel_map, patch, voxel_map.config.cell[order[0]])


def layers_of(voxel_map: VoxelMap, axis: int, heights: Heights) -> NDArray[np.int64]:
    """Return the first and the last layer of cells whose middle is above the lower height, and not above the upper."""
    low, high = heights
    if not (np.isfinite(heights).all() and low < high):
        raise StereovoxError(f"heights {low:g}:{high:g} must be two numbers that rise, LO:HI in metres")
    step = voxel_map.config.cell[axis]
    below, top = np.floor(np.array(heights) / step - 0.5 + TIE)
    layers = np.clip([below + 1, top], -(2.0**40), 2.0**40).astype(np.int64)
    if layers[0] > layers[1]:
        raise StereovoxError(f"heights {low:g}:{high:g} hold the middle of no cell of {step:g} m; widen them")
    return -1 - layers[::-1] if voxel_map.config.up.startswith("-") else layers


def patch_of(
    voxel_map: VoxelMap,
    coords: NDArray[np.int32],
    values: NDArray[np.integer],
    order: list[int],
    layers: NDArray[np.int64],
) -> Patch:
    """Return what blocks (n, 3), n > 0, with their cells (n, 512) as stored, show from above.

    order: axes along columns, along rows and up, see `floor_axes`; layers: as `layers_of` returns them.
    """
    floor = coords[:, order[:2]].astype(np.int64)
    low, high = floor.min(axis=0) * SIDE, (floor.max(axis=0) + 1) * SIDE
    patch = _empty(low, high)
    rules = CellRules(voxel_map.config.map)
    _projection.look_down(
        np.ascontiguousarray(coords), np.ascontiguousarray(values), np.array(order), low, layers,
        np.int16(rules.format.unknown), np.int16(np.ceil(rules.free_below)), patch.marked, patch.cleared,
    )  # fmt: skip
    return patch


def _empty(low: NDArray[np.int64], high: NDArray[np.int64]) -> Patch:
    columns, rows = (high - low).tolist()
    if columns * rows > MOST_CELLS:
        raise StereovoxError(
            f"a grid of {columns} x {rows} cells is too large; map a smaller place, with --set window.size=[X,Y,Z]"
        )
    return Patch(low, np.full((rows, columns), NOTHING, np.int16), np.full((rows, columns), NOTHING, np.int16))


def _joined(patches: list[Patch]) -> Patch | None:
    if len(patches) < 2:
        return patches[0] if patches else None
    ends = [patch.corner + patch.marked.shape[::-1] for patch in patches]
    joined = _empty(np.min([patch.corner for patch in patches], axis=0), np.max(ends, axis=0))
    for patch in patches:
        (left, bottom), (rows, columns) = (patch.corner - joined.corner).tolist(), patch.marked.shape
        here = slice(bottom, bottom + rows), slice(left, left + columns)
        for whole, part in ((joined.marked, patch.marked), (joined.cleared, patch.cleared)):
            whole[here] = np.maximum(whole[here], part)
    return joined


def _grid(voxel_map: VoxelMap, patch: Patch, side: float) -> OccupancyGrid:
    number = np.where(patch.marked != NOTHING, patch.marked, patch.cleared)
    rows, columns = (np.flatnonzero((number != NOTHING).any(axis=across)) for across in (1, 0))
    number = number[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    percent = Percent(CellRules(voxel_map.config.map))
    known = percent.shown[np.maximum(number, percent.lowest).astype(np.int32) - percent.lowest]
    left, bottom = ((patch.corner + np.array([columns[0], rows[0]])) * side).round(9).tolist()
    return OccupancyGrid(
        np.where(number == NOTHING, np.int8(UNKNOWN), known), side, (left, bottom, 0.0),
        percent.free_below, percent.occupied_above,
    )  # fmt: skip


def _nothing_there(voxel_map: VoxelMap, axis: int, heights: Heights) -> str:
    bounds = voxel_map.bounds()
    if bounds is None:
        return "the map is empty: there is nothing to project"
    low, high = bounds[:, axis] if not voxel_map.config.up.startswith("-") else -bounds[::-1, axis]
    between = f"nothing is known at heights {heights[0]:g} to {heights[1]:g} m"
    return f"{between}, the map's own are {low:.2f} to {high:.2f} m; choose others with --heights=LO:HI"
