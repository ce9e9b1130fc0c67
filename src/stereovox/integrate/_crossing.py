# SPDX-License-Identifier: Apache-2.0
"""Kernel that walks rays from one point through cubic cells (Amanatides and Woo 1987), in float64."""

import numpy as np

from stereovox.kernels._jit import allocating_kernel


@allocating_kernel
def walk(origin, ends, first, steps, cells):
    """Write the cells of each ray, from the cell of `origin` (3,) to the cell of its end; coordinates are in cells.

    ends: (N, 3). first: (N,) int64, row of `cells` of each ray's first cell. steps: (N,) int64, number of faces that
    each crosses. cells: (M, 3) int64.
    """
    per_cell, next_face = np.empty(3), np.empty(3)
    at, step = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(ends.shape[0]):
        for axis in range(3):
            ray = ends[i, axis] - origin[axis]
            at[axis] = np.int64(np.floor(origin[axis]))
            step[axis] = -1 if ray < 0 else 1
            per_cell[axis] = np.inf if ray == 0 else 1 / abs(ray)
            next_face[axis] = np.inf if ray == 0 else (at[axis] + (1 if ray > 0 else 0) - origin[axis]) / ray
        row = first[i]
        for axis in range(3):
            cells[row, axis] = at[axis]
        for n in range(1, steps[i] + 1):
            axis = 0
            if next_face[1] < next_face[axis]:
                axis = 1
            if next_face[2] < next_face[axis]:
                axis = 2
            at[axis] += step[axis]
            next_face[axis] += per_cell[axis]
            for k in range(3):
                cells[row + n, k] = at[k]
