# SPDX-License-Identifier: Apache-2.0
"""Neighbouring cells: blocks with a margin, and connected components."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.maps.storage.blocks import MAX_PLACES, SIDE
from stereovox.products import _margin

FACES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
CORNERS = tuple((x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0))
"""Steps to half of the cells that share a face with a cell, and to half of those that share a corner with it."""


def with_margins(voxel_map: VoxelMap) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
    """Yield all blocks (n, 3) of a map with a margin of one cell: (n, 10, 10, 10) as stored."""
    for coords, _ in voxel_map.storage.slabs():
        ends = (coords.min(axis=0), coords.max(axis=0) + 1) if len(coords) else (np.zeros(3, int),) * 2
        stored = voxel_map.storage.cells_within(SIDE * ends[0] - 1, SIDE * ends[1] + 1)
        out = np.empty((len(coords), *(SIDE + 2,) * 3), stored.values.dtype)
        _margin.with_margin(stored, np.ascontiguousarray(coords), out)
        yield coords, out


def shifted(margins: NDArray, step: tuple[int, int, int]) -> NDArray:
    """Return, for each cell (n, 8, 8, 8) of blocks with margins, the cell one `step` (at most one cell) away."""
    x, y, z = (slice(1 + d, 1 + d + SIDE) for d in step)
    return margins[:, x, y, z]


def components(cells: NDArray[np.integer], steps: Iterable[tuple[int, int, int]]) -> NDArray[np.int32]:
    """Return the component (N,), from 0, of each of the distinct cells (N, 3).

    Cells that are one of the `steps` apart, in either direction, belong to one component.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(cells):
        return np.zeros(0, np.int32)
    steps = list(steps)
    number, extent = _places(cells, int(np.abs(steps).max()))
    order = np.argsort(number)
    ascending = number[order]
    pairs = [_apart(ascending, int(np.dot(step, (extent[1] * extent[2], extent[2], 1)))) for step in steps]
    one, other = (order[np.concatenate(ends)] for ends in zip(*pairs, strict=True))
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(len(cells),) * 2)
    return connected_components(graph, directed=False)[1]


def _places(cells: NDArray[np.integer], longest: int) -> tuple[NDArray[np.int64], list[int]]:
    """Return one number (N,) for each cell, and the sides of the box in which they count.

    The box is padded so that no step, at most `longest` on each axis, wraps around.
    """
    low = cells.min(axis=0).astype(np.int64)
    extent = [int(n) + 1 + longest for n in cells.max(axis=0) - low]
    if extent[0] * extent[1] * extent[2] > MAX_PLACES:
        raise StereovoxError("the map is too wide for a search of connected cells; take a part of it: stereovox crop")
    x, y, z = (cells - low).T
    return (x * extent[1] + y) * extent[2] + z, extent


def _apart(ascending: NDArray[np.int64], step: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the positions of all pairs of ascending numbers that are `step` apart."""
    at = np.searchsorted(ascending, ascending + step).clip(max=len(ascending) - 1)
    found = np.flatnonzero(ascending[at] == ascending + step)
    return found, at[found]
