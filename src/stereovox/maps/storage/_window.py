# SPDX-License-Identifier: Apache-2.0
"""Kernels of the rolling map: clear cells that left the window, clip evidence at its border."""

from stereovox.kernels._jit import cell, kernel
from stereovox.maps.cells._cells import copy_row, find
from stereovox.maps.cells._pool import NOTHING, forget, need, with_row


@kernel
def vacate(table, coords, values, count, unknown, lowest, slab_low, slab_high, low, high):
    """Clear the cells of a slab outside the window, and remove blocks without remaining known cells.

    slab_low, slab_high, low, high: (3,) int32 first cell and first cell beyond, of the slab and of the window.
    """
    for bx in range(slab_low[0] >> 3, ((slab_high[0] - 1) >> 3) + 1):
        for by in range(slab_low[1] >> 3, ((slab_high[1] - 1) >> 3) + 1):
            for bz in range(slab_low[2] >> 3, ((slab_high[2] - 1) >> 3) + 1):
                place = find(table, coords, bx, by, bz)
                known = place >= 0 and not _disjoint(bx, by, bz, low, high)
                if known:
                    row = with_row(table, coords, values, count, place, lowest)
                    _keep_inside(bx, by, bz, low, high, values[row], unknown)
                    known = need(values[row], unknown, lowest) != NOTHING
                if not known:
                    forget(table, coords, values, count, bx, by, bz)


@kernel
def clip(coords, values, uniform, uniform_values, low, high, out_coords, out_values, out_uniform, out_uniform_values):
    """Copy the evidence on cells within the window [low, high); return the number of blocks, and of uniform blocks.

    Uniform blocks across the border become ordinary ones.
    """
    n = 0
    for i in range(coords.shape[0]):
        x, y, z = coords[i, 0], coords[i, 1], coords[i, 2]
        if not _disjoint(x, y, z, low, high):
            copy_row(out_coords[n], coords[i])
            copy_row(out_values[n], values[i])
            if not _contained(x, y, z, low, high):
                _keep_inside(x, y, z, low, high, out_values[n], 0)
            n += 1
    whole = 0
    for i in range(uniform.shape[0]):
        x, y, z = uniform[i, 0], uniform[i, 1], uniform[i, 2]
        if _contained(x, y, z, low, high):
            copy_row(out_uniform[whole], uniform[i])
            out_uniform_values[whole] = uniform_values[i]
            whole += 1
        elif not _disjoint(x, y, z, low, high):
            copy_row(out_coords[n], uniform[i])
            out_values[n] = uniform_values[i]
            _keep_inside(x, y, z, low, high, out_values[n], 0)
            n += 1
    return n, whole


@cell
def _disjoint(x, y, z, low, high):
    below = (x + 1) * 8 <= low[0] or (y + 1) * 8 <= low[1] or (z + 1) * 8 <= low[2]
    return below or x * 8 >= high[0] or y * 8 >= high[1] or z * 8 >= high[2]


@cell
def _contained(x, y, z, low, high):
    above = x * 8 >= low[0] and y * 8 >= low[1] and z * 8 >= low[2]
    return above and (x + 1) * 8 <= high[0] and (y + 1) * 8 <= high[1] and (z + 1) * 8 <= high[2]


@cell
def _keep_inside(x, y, z, low, high, block, fill):
    """Set the cells of block (x, y, z) outside [low, high) to `fill`."""
    for i in range(8):
        for j in range(8):
            outside = x * 8 + i < low[0] or x * 8 + i >= high[0] or y * 8 + j < low[1] or y * 8 + j >= high[1]
            for k in range(8):
                if outside or z * 8 + k < low[2] or z * 8 + k >= high[2]:
                    block[64 * i + 8 * j + k] = fill
