# SPDX-License-Identifier: Apache-2.0
"""The cells that the rays of a lidar scan cross, and the evidence of a scan on them: for points that form no image."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.integrate import _crossing
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, SIDE, blocks_of_cells

AT_ONCE = 1 << 22
"""Cells walked before duplicates are dropped."""
MAX_LENGTH = 1 << 20
"""Most cells along each axis from the sensor to the end of a ray."""


def crossed_cells(origin: NDArray[np.float64], ends: NDArray[np.float64], voxel_size: float) -> NDArray[np.int64]:
    """Return the cells (M, 3) that the rays from `origin` (3,) to `ends` (N, 3) cross, each once, in ascending order.

    Origin and ends are in metres. The cells of the ends are included.
    Raises StereovoxError for a ray of more than `MAX_LENGTH` cells.
    """
    start, stop = np.asarray(origin, np.float64) / voxel_size, np.asarray(ends, np.float64).reshape(-1, 3) / voxel_size
    base = np.floor(start).astype(np.int64)
    apart = np.abs(np.floor(stop) - base)
    if len(stop) and not apart.max() < MAX_LENGTH:
        raise StereovoxError(f"a ray of {apart.max() * voxel_size:g} m spans too many cells; use larger cells")
    steps = apart.sum(axis=1).astype(np.int64)
    found = [_packed(np.floor(stop).astype(np.int64) - base)]
    for part in _pieces(steps):
        first = np.cumsum(steps[part] + 1) - steps[part] - 1
        cells = np.empty((int((steps[part] + 1).sum()), 3), np.int64)
        _crossing.walk(start, np.ascontiguousarray(stop[part]), first, steps[part], cells)
        found.append(np.unique(_packed(cells - base)))
    return _unpacked(np.unique(np.concatenate(found))) + base


def scan_evidence(
    origin: NDArray[np.float64], ends: NDArray[np.float64], voxel_size: float, hit: int, miss: int
) -> Evidence:
    """Return the evidence of one scan: `hit` for each cell that holds an end, `miss` for the others that rays cross.

    origin: (3,) and ends: (N, 3) in metres, world frame. Only one ray is walked to each cell with ends, so some cells
    that other rays cross are missed, but none is added. hit, miss: log-odds in thousandths. Raises StereovoxError as
    `crossed_cells`.
    """
    cells = np.floor(ends / voxel_size).astype(np.int64)
    hits, chosen = np.unique(cells, axis=0, return_index=True)
    crossed = crossed_cells(origin, ends[chosen], voxel_size)
    together = np.concatenate([crossed, hits])  # if a cell is in both, the later one counts
    gains = np.repeat(np.array([miss, hit], np.int16), [len(crossed), len(hits)])
    blocks, of_cell = blocks_of_cells(together)
    x, y, z = (together & (SIDE - 1)).T
    values = np.zeros((len(blocks), CELLS), np.int16)
    values[of_cell, (x << 6) | (y << 3) | z] = gains
    return Evidence(blocks.astype(np.int32), values, np.empty((0, 3), np.int32), np.empty(0, np.int16))


def _pieces(steps: NDArray[np.int64]) -> list[slice]:
    """Return runs of rays that cross about `AT_ONCE` cells."""
    run = np.cumsum(steps + 1) // AT_ONCE
    edges = [0, *(np.flatnonzero(np.diff(run)) + 1).tolist(), len(steps)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _packed(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number (N,) for each cell (N, 3) within `MAX_LENGTH` of 0, in the same order as the cells."""
    x, y, z = (cells + MAX_LENGTH).T
    return (x << 42) | (y << 21) | z


def _unpacked(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    mask = (1 << 21) - 1
    return np.stack([numbers >> 42, numbers >> 21 & mask, numbers & mask], axis=1) - MAX_LENGTH
