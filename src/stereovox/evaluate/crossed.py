# SPDX-License-Identifier: Apache-2.0
"""Which cells straight rays cross, all rays at once (Amanatides and Woo 1987)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import Keys, keys


def crossed_cells(origin: NDArray[np.float64], ends: NDArray[np.float64], voxel_size: float) -> Keys:
    """Return the cells, as ascending keys without repeats, that the rays from `origin` (3,) to `ends` (N, 3) cross.

    All in metres. Those that hold the ends belong to them.
    """
    start, stop = origin / voxel_size, ends / voxel_size
    cell = np.broadcast_to(np.floor(start), stop.shape).copy()
    last, way = np.floor(stop), stop - start
    step = np.where(way < 0, -1.0, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_cell = np.where(way == 0, np.inf, 1 / np.abs(way))  # share of the way from one face to the next
        next_face = np.where(way == 0, np.inf, (cell + (step > 0) - start) / way)
    left = np.abs(last - cell).sum(axis=1).astype(int)  # a ray crosses as many faces as its cells are apart
    found = [keys(last)]
    while len(cell):
        found.append(np.unique(keys(cell)))
        going = left > 0
        cell, next_face, per_cell, step, left = (a[going] for a in (cell, next_face, per_cell, step, left))
        axis, row = np.argmin(next_face, axis=1), np.arange(len(cell))
        cell[row, axis] += step[row, axis]
        next_face[row, axis] += per_cell[row, axis]
        left -= 1
    return np.unique(np.concatenate(found))
