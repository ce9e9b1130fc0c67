# SPDX-License-Identifier: Apache-2.0
"""Kernels that add a frame's evidence to the blocks of a map, in four steps.

`places` looks where the blocks of the evidence are, `make_rows` makes the rows that are missing, `add` fills them, on
any number of threads, and `settle` takes the rows from blocks that have sunk to the floor. The evidence is `coords`
(n, 3) with `values` (n, 512) int16, then `uniform` (m, 3), all of whose cells get one negative step each.
"""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.maps._cells import find, says_something
from stereovox.maps._pool import BARE, make_bare, need, new_row, with_row

SKIP, MAKE = np.int32(-1), np.int32(-2)
"""In place of a row: the evidence changes nothing in this block; it needs a row."""
LOW, HIGH = np.int64(-32768), np.int64(32767)
NIL, ONE = np.int16(0), np.int16(1)
ZERO = np.float32(0)


@kernel
def places(table, coords, values, wanted, steps, uniform, out):
    """Write the row of each block, or SKIP, or MAKE, to `out` (n + m,) int32; return the number of rows to make.

    A block at the floor stays as it is unless something in it rises; one without any evidence is not made.
    """
    rows, n, made = values.shape[0], wanted.shape[0], 0
    for i in range(n):
        place = _find(table, coords, wanted, i)
        if place < 0:
            place = MAKE if says_something(steps[i]) else SKIP
        elif place >= rows:
            place = MAKE if _raises(steps[i]) else SKIP
        made += place == MAKE
        out[i] = place
    for i in range(uniform.shape[0]):
        place = _find(table, coords, uniform, i)
        if place < 0:
            place = MAKE
        elif place >= rows:
            place = SKIP
        made += place == MAKE
        out[n + i] = place
    return made


@kernel
def make_rows(table, coords, values, count, wanted, unknown, lowest, rows):
    """Make a row for each block of `wanted` (n, 3) marked MAKE in `rows` (n,), and write it there."""
    for i in range(rows.size):
        if rows[i] == MAKE:
            place = _find(table, coords, wanted, i)
            if place >= 0:
                rows[i] = with_row(table, coords, values, count, place, lowest)
            else:
                rows[i] = row = new_row(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])
                values[row] = unknown


@kernel
def add(values, rows, start, stop, steps, uniform_steps, same, unknown, prior, lowest, highest, floored):
    """Add the evidence of blocks `start` to `stop`; return how many cells changed.

    All numbers are int16: steps (n, 512), uniform_steps (m,), and `same` (512,), scratch. `floored` (n + m,) is set to
    1 for blocks whose cells are all at the floor now.
    """
    changed, n = 0, steps.shape[0]
    for i in range(start, stop):
        if rows[i] >= 0:
            if i >= n:
                same[:] = uniform_steps[i - n]
            given = steps[i] if i < n else same
            moved, above = _add_to_row(values[rows[i]], given, unknown, prior, lowest, highest)
            changed += np.int64(moved)
            floored[i] = above == 0
    return changed


@kernel
def settle(table, coords, values, count, wanted, floored, unknown, lowest):
    """Take the rows from the blocks of `wanted` (n, 3) marked in `floored` (n,)."""
    for i in range(floored.size):
        if floored[i]:
            row = _find(table, coords, wanted, i)
            if row < values.shape[0] and need(values[row], unknown, lowest) == BARE:
                make_bare(table, coords, values, count, row)


@kernel
def rescale(values, factor, shift, most, out):
    """Write `values` (n, 512) times `factor`, plus `shift`, rounded down to whole numbers, to `out` (n, 512) int16.

    None is more than `most`.
    """
    for i in range(values.shape[0]):
        for c in range(512):
            value = np.float32(values[i, c])
            out[i, c] = np.int16(min(np.floor(value * factor + shift), most) if value != ZERO else ZERO)


@cell
def _add_to_row(block, steps, unknown, prior, lowest, highest):
    """Add `steps` (512,) to the cells of a block; return how many changed, and 0 if all are at the floor now."""
    moved, above = NIL, NIL
    for c in range(512):
        old = np.int16(block[c])
        new = _added(old, steps[c], unknown, prior, lowest, highest)
        moved = np.int16(moved + (ONE if new != old else NIL))
        above = np.int16(above | np.int16(new ^ lowest))
        block[c] = new
    return moved, above


@cell
def _added(old, step, unknown, prior, lowest, highest):
    """What `_cells.added` says, all in int16: twice as many cells in one instruction. The compiler makes of the first
    clamp an addition that saturates."""
    start = prior if old == unknown else old
    total = np.int16(min(max(np.int64(start) + np.int64(step), LOW), HIGH))
    new = min(max(total, lowest), highest)
    new = np.int16(new + (ONE if new == unknown else NIL))
    return new if step != NIL else old


@cell
def _find(table, coords, wanted, i):
    return find(table, coords, wanted[i, 0], wanted[i, 1], wanted[i, 2])


@cell
def _raises(steps):
    most = NIL
    for c in range(512):
        most = max(most, steps[c])
    return most > NIL
