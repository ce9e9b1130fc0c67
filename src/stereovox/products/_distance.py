# SPDX-License-Identifier: Apache-2.0
"""Kernel that finds which cells of a box became obstacles of a map, or ceased to be.

Kernel that pads blocks with one cell of their neighbours.

Kernels of the exact distance transform that redo only what may have changed; see `Transform` for the arrays.

Squared distances add up axis by axis: along the rows of a slab by counting cells, along the lanes of a row and across
the slabs of a plane as the minimum of `square + cost[cells off]`. A changed sum matters elsewhere only if it was or
becomes the minimum: rows for which it does neither are not visited again.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell, kernel
from stereovox.maps.cells import _cells
from stereovox.maps.cells._cells import NO_ROW, number_in, row_of
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


SIDE = 8


@kernel
def with_margin(stored, coords, out):
    """Write the cells of blocks (n, 3), as stored, to `out` (n, 10, 10, 10), surrounded by their neighbours' cells."""
    for n in range(coords.shape[0]):
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    row = row_of(
                        stored, np.int32(coords[n, 0] + dx), np.int32(coords[n, 1] + dy), np.int32(coords[n, 2] + dz)
                    )
                    for x in range(SIDE - 1 if dx < 0 else 0, 1 if dx > 0 else SIDE):
                        for y in range(SIDE - 1 if dy < 0 else 0, 1 if dy > 0 else SIDE):
                            for z in range(SIDE - 1 if dz < 0 else 0, 1 if dz > 0 else SIDE):
                                out[n, 1 + x + SIDE * dx, 1 + y + SIDE * dy, 1 + z + SIDE * dz] = number_in(
                                    stored, row, x, y, z
                                )


FAR = np.int16(32000)
FEW = 16
"""With more changed lanes than this a row is rebuilt without a test."""
UNCHANGED, INFINITE = np.float32(-1), np.float32(np.inf)
NO, YES, LARGEST = np.int32(0), np.int32(1), np.int32(2**31 - 1)
NEAR, ONE = np.int16(0), np.int16(1)


@allocating_kernel
def across_slabs(field, costs, lanes, dirty, first, step):
    """Bring `runs` and `partial` up to date in the slabs first, first + step, ... that are `dirty` (slabs,).

    lanes: number of lanes of a row that are cells; the others are padding. Marks changes in `touched`.
    """
    slabs, rows, padded = field.mask.shape
    runs = np.empty((rows, padded), np.int16)
    line = np.full(3 * padded, np.float32(costs.none), np.float32)
    best, moved = np.zeros(padded, np.float32), np.empty(padded, np.int32)
    for a in range(first, slabs, step):
        if dirty[a]:
            _count(field.mask[a], runs)
            for b in range(rows):
                number = _listed(runs[b], field.runs[a, b], lanes, moved)
                if number:
                    old = field.partial[b, a]
                    if not _amended(runs[b], field.runs[a, b], moved[:number], costs, old, best):
                        _rebuild(runs[b], lanes, costs, line, best)
                    for c in range(padded):
                        field.runs[a, b, c] = runs[b, c]
                    _replace(field, b, a, lanes, best)


@allocating_kernel
def across_planes(field, costs, first, step):
    """Bring `squares` and `metres` up to date in the planes first, first + step, ... that are `touched`."""
    rows, slabs, padded = field.squares.shape
    best, listed = np.empty(padded, np.float32), np.empty(slabs, np.int64)
    for b in range(first, rows, step):
        number = 0
        for a in range(slabs):
            if field.touched[b, a] >= NO:
                listed[number] = a
                number += 1
        for a in range(slabs if number else 0):
            _renew(field, costs, b, a, listed[:number], best)
        for i in range(number):
            field.touched[b, listed[i]] = UNCHANGED


@cell
def _bits(number):
    """Return a number of 0 or more as an integer of the same order: the maximum of many then vectorises."""
    return np.float32(number).view(np.int32)


@cell
def _number(bits):
    return np.int32(bits).view(np.float32)


@cell
def _count(mask, runs):
    """Write the distance in rows to the next obstacle of the same lane, FAR if there is none."""
    rows, padded = mask.shape
    for c in range(padded):
        runs[0, c] = NEAR if mask[0, c] else FAR
    for b in range(1, rows):
        for c in range(padded):
            further = min(np.int16(runs[b - 1, c] + ONE), FAR)
            runs[b, c] = NEAR if mask[b, c] else further
    for b in range(rows - 2, -1, -1):
        for c in range(padded):
            runs[b, c] = min(np.int16(runs[b + 1, c] + ONE), runs[b, c])


@cell
def _listed(new, old, lanes, moved):
    """List the lanes in which two rows differ; return how many there are."""
    differ = NEAR
    for c in range(new.size):
        differ |= np.int16(new[c] ^ old[c])
    number = 0
    for c in range(lanes if differ else 0):
        moved[number] = c
        number += 1 if new[c] != old[c] else 0
    return number


@cell
def _square(costs, run):
    """Return the square of a run along the rows."""
    return min(costs.along[run], costs.none) if run < costs.along.size else costs.none


@cell
def _amended(new, old, moved, costs, before, best):
    """Set `best` to the row `before`, amended for the lanes that moved; return whether that suffices.

    It does if no lane that moved away was the nearest of any other.
    """
    if moved.size > FEW:
        return False
    middle = costs.lanes.size // 2
    for c in range(best.size):
        best[c] = before[c]
    for c in moved:
        if new[c] < old[c]:
            _lower(best, costs.lanes[middle - c : middle - c + best.size], _square(costs, new[c]))
    missed = NO
    for c in moved:
        square = _square(costs, old[c])
        if new[c] > old[c] and square < costs.none:
            for other in range(best.size):
                missed |= YES if costs.lanes[middle - c + other] + square <= best[other] else NO
    return missed == NO


@cell
def _rebuild(runs, lanes, costs, line, best):
    """Rebuild a row; `line` holds it between two rows without obstacles, so that any offset can be read."""
    padded, middle = best.size, costs.lanes.size // 2
    least, most = LARGEST, NO
    for c in range(lanes):
        square = _square(costs, runs[c])
        line[padded + c] = best[c] = square
        least, most = min(least, _bits(square)), max(most, _bits(square))
    for d in range(1, lanes if _number(least) < costs.none else 1):
        cost = costs.lanes[middle + d]
        if _bits(cost) >= most:
            return
        most = _lower_by_two(best, line[padded - d : 2 * padded - d], line[padded + d : 2 * padded + d], cost)


@cell
def _replace(field, b, a, lanes, best):
    """Store `best` as a row of `partial`; record earlier values that were smaller, and the least that changed."""
    row, superseded = field.partial[b, a], field.superseded[b, a]
    least, lowest = LARGEST, LARGEST
    for c in range(best.size):
        old, new = row[c], best[c]
        least = min(least, _bits(min(old, new)) if old != new else LARGEST)
        lowest = min(lowest, _bits(new) if c < lanes else LARGEST)
        superseded[c] = old if old < new else INFINITE
        row[c] = new
    if least < LARGEST:
        field.touched[b, a], field.lowest[b, a] = _number(least), _number(lowest)


@cell
def _renew(field, costs, b, a, listed, best):
    """Bring row a of plane b up to date; the rows `listed` of the plane have changed."""
    row, cost, highest = field.squares[b, a], costs.across, field.highest[b, a]
    seen, missed = NO, YES if 2 * listed.size > cost.size else NO
    most = _bits(highest)
    if missed == NO:
        for c in range(best.size):
            best[c] = row[c]
        for other in listed:
            off = cost[abs(a - other)]
            if field.touched[b, other] + off <= highest and missed == NO:
                most, missed = _lower_unless_missed(best, field.partial[b, other], field.superseded[b, other], off)
                seen = YES
    if missed:
        most = _across(field.partial[b], field.lowest[b], cost, a, best)
    if missed | seen:
        metres = field.metres[b, a]
        for c in range(best.size):
            row[c] = best[c]
            metres[c] = np.sqrt(best[c]) * costs.unit if best[c] < costs.none else INFINITE
        field.highest[b, a] = _number(most)


@cell
def _across(rows, lowest, cost, a, best):
    """Set `best` to the least of all rows of a plane as seen from row a; return its maximum as bits."""
    most = NO
    for c in range(best.size):
        best[c] = rows[a, c]
        most = max(most, _bits(best[c]))
    for d in range(1, cost.size):
        if _bits(cost[d]) >= most:
            return most
        below = a >= d and _bits(lowest[max(a - d, 0)] + cost[d]) < most
        above = a + d < cost.size and _bits(lowest[min(a + d, cost.size - 1)] + cost[d]) < most
        if below and above:
            most = _lower_by_two(best, rows[a - d], rows[a + d], cost[d])
        elif below or above:
            most = _lower(best, rows[a - d if below else a + d], cost[d])
    return most


@cell
def _lower(best, row, cost):
    """Lower `best` to row + cost if that is less; return its maximum as bits."""
    most = NO
    for c in range(best.size):
        other = row[c] + cost
        least = other if other < best[c] else best[c]
        best[c] = least
        most = max(most, _bits(least))
    return most


@cell
def _lower_by_two(best, row, mirrored, cost):
    most = NO
    for c in range(best.size):
        other = (row[c] if row[c] < mirrored[c] else mirrored[c]) + cost
        least = other if other < best[c] else best[c]
        best[c] = least
        most = max(most, _bits(least))
    return most


@cell
def _lower_unless_missed(best, row, superseded, cost):
    """Do as `_lower`, and return whether a `superseded` value of the row may have been the minimum anywhere."""
    most, missed = NO, NO
    for c in range(best.size):
        other = row[c] + cost
        least = other if other < best[c] else best[c]
        best[c] = least
        most = max(most, _bits(least))
        missed |= YES if superseded[c] + cost <= least else NO
    return most, missed
