# SPDX-License-Identifier: Apache-2.0
"""Kernel that withdraws unsafe free cells of a map resampled in a new frame.

A cell of the new frame is askew among the cells of the old one. The separating axis theorem finds which of them it
overlaps (Gottschalk, Lin, Manocha 1996, OBBTree): two boxes are disjoint exactly if one of 15 directions, the same
for all cells, separates them.
"""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell
from stereovox.maps.cells import _cells
from stereovox.maps.cells._cells import number_in
from stereovox.maps.query._query import LATELY, NOWHERE, row_again, state_of

UNKNOWN, FREE, TENTATIVE = np.int32(_cells.UNKNOWN), np.int32(_cells.FREE), np.int32(_cells.TENTATIVE)
SAMPLES = 4
"""Samples along each side of a cell that measure its overlap with cells of the old frame."""
STEP, HALF, NIL, ONE = np.float32(1 / SAMPLES), np.float32(0.5), np.int32(0), np.int32(1)


@allocating_kernel
def doubt(stored, rules, prior, turn, axes, reach, low, rest, cells):
    """Change the free ones of `cells` (n, 512), blocks in the new frame, that overlap cells that are not free.

    A cell that overlaps an occupied or tentative one becomes tentative; else one that overlaps an unknown one becomes
    unknown. stored, rules: of the map in the old frame. turn: (3, 3) float32, a step of one cell in the new frame in
    cells of the old one. axes, reach: (15, 3), (15,) float32: two cells are disjoint if, along one of these directions,
    their centres are farther apart than its reach; in cells of the old frame. low + rest: (n, 3) int32 + float32, the
    lowest corner of each block in cells of the old frame.
    """
    lately = np.full(LATELY, NOWHERE, np.int32)
    for n in range(cells.shape[0]):
        for c in range(512):
            if state_of(stored, rules, np.int32(cells[n, c])) == FREE:
                x, y, z = np.float32(c >> 6), np.float32((c >> 3) & 7), np.float32(c & 7)
                worst = _worst_overlapped(stored, rules, turn, axes, reach, low[n], rest[n], x, y, z, lately)
                if worst == UNKNOWN:
                    cells[n, c] = stored.unknown
                elif worst == TENTATIVE:
                    rise = _rise(stored, prior, turn, low[n], rest[n], x, y, z, lately)
                    cells[n, c] = _tentative(stored, rules, np.int32(prior + rise))


@cell
def _worst_overlapped(stored, rules, turn, axes, reach, low, rest, x, y, z, lately):
    """Return TENTATIVE if the cell overlaps a tentative or occupied one, else UNKNOWN if it overlaps one, else FREE."""
    worst = FREE
    px, py, pz = _place(turn, rest, x + HALF, y + HALF, z + HALF)
    wx, wy, wz = _half_width(turn, 0), _half_width(turn, 1), _half_width(turn, 2)
    for i in range(np.int64(np.floor(px - wx)), np.int64(np.floor(px + wx)) + 1):
        for j in range(np.int64(np.floor(py - wy)), np.int64(np.floor(py + wy)) + 1):
            for k in range(np.int64(np.floor(pz - wz)), np.int64(np.floor(pz + wz)) + 1):
                state = state_of(stored, rules, _number(stored, low, i, j, k, lately))
                if state != FREE and not (state == UNKNOWN and worst == UNKNOWN):
                    dx, dy, dz = np.float32(i) + HALF - px, np.float32(j) + HALF - py, np.float32(k) + HALF - pz
                    if _overlap(axes, reach, dx, dy, dz):
                        if state != UNKNOWN:
                            return TENTATIVE
                        worst = UNKNOWN
    return worst


@cell
def _overlap(axes, reach, dx, dy, dz):
    overlap = True
    for a in range(reach.size):
        overlap &= abs(dx * axes[a, 0] + dy * axes[a, 1] + dz * axes[a, 2]) < reach[a]
    return overlap


@cell
def _rise(stored, prior, turn, low, rest, x, y, z, lately):
    """Return the evidence for an obstacle in the cells that a cell overlaps, each weighted by its share of it."""
    total = NIL
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            for k in range(SAMPLES):
                inside = (np.float32(i) + HALF) * STEP, (np.float32(j) + HALF) * STEP, (np.float32(k) + HALF) * STEP
                px, py, pz = _place(turn, rest, x + inside[0], y + inside[1], z + inside[2])
                at = np.int64(np.floor(px)), np.int64(np.floor(py)), np.int64(np.floor(pz))
                number = _number(stored, low, at[0], at[1], at[2], lately)
                total += np.int32(max(number - prior, NIL)) if number != stored.unknown else NIL
    return np.int32(total // (SAMPLES * SAMPLES * SAMPLES))


@cell
def _tentative(stored, rules, number):
    """Return the tentative number nearest to one; if there is none, unknown or the lowest non-free one."""
    number = max(min(number, np.int32(rules.occupied_least - ONE)), np.int32(rules.free_most + ONE))
    room = number == stored.unknown and number + ONE < rules.occupied_least
    return np.int32(number + (ONE if room else NIL))


@cell
def _number(stored, low, i, j, k, lately):
    x, y, z = np.int64(low[0]) + i, np.int64(low[1]) + j, np.int64(low[2]) + k
    return number_in(stored, row_again(stored, lately, x >> 3, y >> 3, z >> 3), x, y, z)


@cell
def _place(turn, rest, x, y, z):
    """Return a point in a block of the new frame, in cells of the old one relative to the block's `low`."""
    return (
        rest[0] + turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        rest[1] + turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        rest[2] + turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@cell
def _half_width(turn, axis):
    return HALF * (abs(turn[axis, 0]) + abs(turn[axis, 1]) + abs(turn[axis, 2]))
