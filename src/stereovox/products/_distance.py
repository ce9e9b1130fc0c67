# SPDX-License-Identifier: Apache-2.0
"""Kernel that finds which cells of a box became obstacles of a map, or ceased to be."""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell
from stereovox.maps.cells import _cells
from stereovox.maps.cells._cells import NO_ROW, row_of
from stereovox.maps.query._query import state_of

UNKNOWN, BIT = np.int32(_cells.UNKNOWN), np.uint8(1)


@allocating_kernel
def refresh(stored, rules, wanted, low, order, shape, seen, mask, dirty):
    """Bring `seen` and `mask` up to date with a map; mark changed slabs in `dirty`, return how many cells changed.

    wanted: (1,) uint8 bits of the states that are obstacles. low: (3,) first cell of the box. order, shape: map axis
    and length of each axis (a, b, c) of `mask`. seen: (blocks, 512) uint8, 1 if a cell
    was an obstacle; blocks in the order of their coordinates.
    """
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(3):
        axis = order[n]
        first[axis], last[axis] = low[axis] >> 3, (low[axis] + shape[n] - 1) >> 3
    now = np.empty(512, np.uint8)
    number, changed = 0, 0
    for x in range(first[0], last[0] + 1):
        for y in range(first[1], last[1] + 1):
            for z in range(first[2], last[2] + 1):
                if _find_changes(stored, rules, wanted, x, y, z, now, seen[number]):
                    block = (8 * x - low[0], 8 * y - low[1], 8 * z - low[2])
                    changed += _enter(now, seen[number], block, order, shape, mask, dirty)
                number += 1
    return changed


@cell
def _find_changes(stored, rules, wanted, x, y, z, now, seen):
    """Set `now` (512,) to the obstacles among a block's cells; return whether any differs from `seen`."""
    row = row_of(stored, x, y, z)
    differ = np.uint8(0)
    if row < 0:
        state = UNKNOWN if row == NO_ROW else state_of(stored, rules, stored.lowest)
        flag = np.uint8((wanted[0] >> np.uint8(state)) & BIT)
        for c in range(512):
            now[c] = flag
            differ |= np.uint8(flag ^ seen[c])
    else:
        for c in range(512):
            state = state_of(stored, rules, np.int32(stored.values[row, c]))
            flag = np.uint8((wanted[0] >> np.uint8(state)) & BIT)
            now[c] = flag
            differ |= np.uint8(flag ^ seen[c])
    return differ != 0


@cell
def _enter(now, seen, block, order, shape, mask, dirty):
    """Enter the changes from `seen` of a block whose first cell is at `block` in the box."""
    changed = 0
    for c in range(512):
        if now[c] != seen[c]:
            seen[c] = now[c]
            place = (block[0] + (c >> 6), block[1] + ((c >> 3) & 7), block[2] + (c & 7))
            i, j, k = place[order[0]], place[order[1]], place[order[2]]
            if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
                mask[i, j, k] = now[c]
                dirty[i] = 1
                changed += 1
    return changed
