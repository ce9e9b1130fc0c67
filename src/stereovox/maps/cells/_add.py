# SPDX-License-Identifier: Apache-2.0
"""Kernels that compare a frame's evidence with the blocks of a map, and add it to them.

`places` finds the blocks of the evidence, `make_rows` creates missing rows, `add` fills them, on any number of threads,
and `settle` removes the rows of blocks that have sunk to the floor value. The evidence is `coords` (n, 3) with `values`
(n, 512) int16, then `uniform` (m, 3), all of whose cells get one negative step each.
"""

import numpy as np

from stereovox.kernels._jit import cell, kernel
from stereovox.kernels._math import floor
from stereovox.maps.cells._cells import AT_FLOOR, find, row_of, says_something
from stereovox.maps.cells._pool import BARE, make_bare, need, new_row, with_row

NONE, NIL = np.int32(0), np.int16(0)
MIX_X, MIX_Y, MIX_Z = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77), np.uint32(0xC2B2AE3D)
SHIFT = np.uint32(16)
"""Low bits of a product depend only on low bits; bits from here up depend on all."""


@kernel
def weigh(stored, sure, least, coords, values, uniform, steps, mask, out):
    """Write the weights of the evidence on certain cells, in the units of `values`, to `out` (5,) float64.

    out: evidence for occupied cells (hits), against certainly occupied cells (looked through), against certainly free
    cells (hits), the part of the latter next to an unknown cell of their block, and all hits, whatever the map holds.
    Hits below `least` count for cells, but not against them. sure: (certainly free up to, occupied from, certainly
    occupied from). coords (n, 3) with values (n, 512) int16, then uniform (m, 3), all of whose cells get one of `steps`
    (m,) each. Only blocks whose hash has zeros where `mask` has ones are inspected: the choice does not depend on their
    order.
    """
    hits, passes, into, edge, every = np.int64(0), np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for i in range(coords.shape[0]):
        if chosen(coords, i, mask):
            one = weighed(stored, sure, least, coords, i, values[i])
            hits, passes, into, edge, every = (
                hits + one[0], passes + one[1], into + one[2], edge + one[3], every + one[4],
            )  # fmt: skip
    for i in range(uniform.shape[0]):
        if chosen(uniform, i, mask):
            passes += looked_through(stored, sure, uniform, i, steps[i])
    out[0], out[1], out[2], out[3], out[4] = hits, passes, into, edge, every


@cell
def weighed(stored, sure, least, coords, i, said):
    """Return the five weights, as in `weigh`, of evidence `said` (512,) on block `i` of `coords`."""
    row = row_of(stored, coords[i, 0], coords[i, 1], coords[i, 2])
    if row >= 0:
        hits, passes, into, every = _of_row(said, least, stored.values[row], sure)
        edge = np.int64(0)
        if into:
            edge = _at_edge(said, least, stored.values[row], stored.unknown, sure)
        return hits, passes, into, edge, every
    found = _hits(said, least)
    into = found if (row == AT_FLOOR) & (np.int16(stored.lowest) <= sure[0]) else np.int64(0)
    return np.int64(0), np.int64(0), into, np.int64(0), found


@cell
def looked_through(stored, sure, coords, i, step):
    """Return the weight against certainly occupied cells if all cells of block `i` of `coords` get a step."""
    row = row_of(stored, coords[i, 0], coords[i, 1], coords[i, 2])
    return -np.int64(step) * _occupied(stored.values[row], sure) if row >= 0 else np.int64(0)


@cell
def chosen(coords, i, mask):
    """Return whether block `i` of `coords` is inspected; see `weigh`."""
    mixed = np.uint32(coords[i, 0]) * MIX_X ^ np.uint32(coords[i, 1]) * MIX_Y ^ np.uint32(coords[i, 2]) * MIX_Z
    return (np.uint32(mixed >> SHIFT) & mask) == 0


@cell
def _of_row(said, least, cells, sure):
    """Return the weights of (512,) evidence for and against occupied cells, against free ones, and of its firm hits.

    All but the sums are int16: twice as many cells per instruction.
    """
    hits, passes, into, every = NONE, NONE, NONE, NONE
    for c in range(512):
        value, number = said[c], np.int16(cells[c])
        hit, miss = max(value, NIL), max(np.int16(-value), NIL)
        firm = value if value >= least else NIL
        hits = np.int32(hits + np.int32(hit if number >= sure[1] else NIL))
        passes = np.int32(passes + np.int32(miss if number >= sure[2] else NIL))
        into = np.int32(into + np.int32(firm if number <= sure[0] else NIL))
        every = np.int32(every + np.int32(firm))
    return np.int64(hits), np.int64(passes), np.int64(into), np.int64(every)


@cell
def _at_edge(said, least, cells, unknown, sure):
    """Return the weight of (512,) evidence against free cells next to an unknown one of the same block."""
    weight = NONE
    for c in range(512):
        if (said[c] >= least) & (np.int16(cells[c]) <= sure[0]):
            x, y, z = c >> 6, (c >> 3) & 7, c & 7
            edge = (x > 0) & (np.int32(cells[max(c - 64, 0)]) == unknown)
            edge |= (x < 7) & (np.int32(cells[min(c + 64, 511)]) == unknown)
            edge |= (y > 0) & (np.int32(cells[max(c - 8, 0)]) == unknown)
            edge |= (y < 7) & (np.int32(cells[min(c + 8, 511)]) == unknown)
            edge |= (z > 0) & (np.int32(cells[max(c - 1, 0)]) == unknown)
            edge |= (z < 7) & (np.int32(cells[min(c + 1, 511)]) == unknown)
            weight = np.int32(weight + (np.int32(said[c]) if edge else NONE))
    return np.int64(weight)


@cell
def _hits(said, least):
    hits = NONE
    for c in range(512):
        hits = np.int32(hits + np.int32(said[c] if said[c] >= least else NIL))
    return np.int64(hits)


@cell
def _occupied(cells, sure):
    """Return how many cells (512,) are certainly occupied."""
    number = NONE
    for c in range(512):
        number = np.int32(number + (np.int32(1) if np.int16(cells[c]) >= sure[2] else NONE))
    return np.int64(number)


SKIP, MAKE = np.int32(-1), np.int32(-2)
"""Instead of a row: the evidence changes nothing in this block; the block needs a row."""
LOW, HIGH = np.int64(-32768), np.int64(32767)
NIL, ONE = np.int16(0), np.int16(1)
ZERO = np.float32(0)


@kernel
def places(table, coords, values, wanted, steps, uniform, out):
    """Write the row of each block, or SKIP, or MAKE, to `out` (n + m,) int32; return the number of rows to create.

    A block at the floor value is unchanged unless a cell rises; one without any evidence is not created.
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
    """Create a row for each block of `wanted` (n, 3) marked MAKE in `rows` (n,), and write its index there."""
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
    1 for blocks whose cells are now all at the floor value.
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
    """Remove the rows of the blocks of `wanted` (n, 3) marked in `floored` (n,)."""
    for i in range(floored.size):
        if floored[i]:
            row = _find(table, coords, wanted, i)
            if row < values.shape[0] and need(values[row], unknown, lowest) == BARE:
                make_bare(table, coords, values, count, row)


@kernel
def rescale(values, factor, shift, most, out):
    """Write `values` (n, 512) times `factor`, plus `shift`, rounded down to whole numbers, to `out` (n, 512) int16.

    Values are capped at `most`.
    """
    for i in range(values.shape[0]):
        for c in range(512):
            out[i, c] = rescaled(values[i, c], factor, shift, most)


@cell
def rescaled(value, factor, shift, most):
    """Return one cell's evidence as `rescale` does."""
    value = np.float32(value)
    return np.int16(min(floor(value * factor + shift), most) if value != ZERO else ZERO)


@cell
def _add_to_row(block, steps, unknown, prior, lowest, highest):
    """Add `steps` (512,) to the cells of a block; return how many changed, and 0 if all are now at the floor value."""
    moved, above = NIL, NIL
    for c in range(512):
        old = np.int16(block[c])
        new = added_step(old, steps[c], unknown, prior, lowest, highest)
        moved = np.int16(moved + (ONE if new != old else NIL))
        above = np.int16(above | np.int16(new ^ lowest))
        block[c] = new
    return moved, above


@cell
def added_step(old, step, unknown, prior, lowest, highest):
    """Do as `_cells.added`, all in int16: twice as many cells per instruction.

    The compiler turns the first clamp into a saturating addition.
    """
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
