# SPDX-License-Identifier: Apache-2.0
"""Kernel of the search for loops: scores of points on a coarse grid, for all shifts within a window."""

from stereovox.kernels._jit import kernel


@kernel
def scores(grid, cells, found):
    """Write to `found` (X, Z, Y) int32 the sum of `grid` over all cells, shifted by (x, y, z) minus half the window.

    grid: (I, K, J) int8; 0 beyond it. cells: (N, 3) int32. The sizes of `found` are odd. The second axis is last in
    both, because windows are flat: whole rows of the grid are added to rows of the window.
    """
    half_x, half_z, half_y = found.shape[0] // 2, found.shape[1] // 2, found.shape[2] // 2
    for x in range(found.shape[0]):
        found[x] = 0
        for n in range(cells.shape[0]):
            i = cells[n, 0] + x - half_x
            if not 0 <= i < grid.shape[0]:
                continue
            row = cells[n, 1] - half_y
            first, last = max(0, -row), min(found.shape[2], grid.shape[2] - row)
            for z in range(found.shape[1]):
                k = cells[n, 2] + z - half_z
                if 0 <= k < grid.shape[1]:
                    sums, row_of_grid = found[x, z, first:last], grid[i, k, row + first : row + last]
                    for y in range(last - first):
                        sums[y] += row_of_grid[y]
