# SPDX-License-Identifier: Apache-2.0
"""Kernel of the search for loops: how well points lie on a coarse grid, for all shifts within a window."""

from stereovox._jit import kernel


@kernel
def scores(grid, cells, found):
    """Write to `found` (X, Y, Z) int32 the sum of `grid` over all cells, shifted by (x, y, z) less half the window.

    grid: (I, J, K) int8; beyond it is 0. cells: (N, 3) int32. The sizes of `found` are odd.
    """
    half_x, half_y, half_z = found.shape[0] // 2, found.shape[1] // 2, found.shape[2] // 2
    for x in range(found.shape[0]):
        for y in range(found.shape[1]):
            for z in range(found.shape[2]):
                total = 0
                for n in range(cells.shape[0]):
                    i, j, k = cells[n, 0] + x - half_x, cells[n, 1] + y - half_y, cells[n, 2] + z - half_z
                    inside = 0 <= i < grid.shape[0] and 0 <= j < grid.shape[1] and 0 <= k < grid.shape[2]
                    if inside:
                        total += grid[i, j, k]
                found[x, y, z] = total
