# SPDX-License-Identifier: Apache-2.0
"""Kernels for an exhaustive search: branch and bound over positions and turns (Hess et al. 2016, III)."""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell, kernel

ZERO = np.float32(0)


@kernel
def coarsen(field, pad, pyramid):
    """Write maxima of a score field over windows of 2^h by 2^h cells, from each cell towards higher rows and columns.

    field: (rows, columns) float32. pyramid: (levels, rows + pad, columns + pad) float32: level h at [r + pad, c + pad]
    holds the window from (r, c); before the field's first row and column there is room for windows that reach into it.
    """
    levels, rows, columns = pyramid.shape
    for r in range(rows):
        for c in range(columns):
            inside = r >= pad and c >= pad
            pyramid[0, r, c] = field[r - pad, c - pad] if inside else ZERO
    for h in range(1, levels):
        half = 1 << (h - 1)
        for r in range(rows):
            for c in range(columns):
                top = pyramid[h - 1, r, c]
                if r + half < rows:
                    top = max(top, pyramid[h - 1, r + half, c])
                if c + half < columns:
                    top = max(top, pyramid[h - 1, r, c + half])
                    if r + half < rows:
                        top = max(top, pyramid[h - 1, r + half, c + half])
                pyramid[h, r, c] = top


@cell
def _total(places, k, row, column, level, pyramid, pad):
    rows, columns = pyramid.shape[1], pyramid.shape[2]
    total = ZERO
    for i in range(places.shape[1]):
        r, c = places[k, i, 0] + row + pad, places[k, i, 1] + column + pad
        if r >= 0 and c >= 0 and r < rows and c < columns:
            total += pyramid[level, r, c]
    return total


@allocating_kernel
def climb(places, side, pyramid, pad, least, taken, apart, best):
    """Find the turn and shift of a cloud with the largest score, if it is above `least`; return that score.

    places: (turns, N, 2) int32 row and column of each point for every turn tried. side: largest shift in cells, in each
    direction. best: (3,) int64 turn, rows, columns, written (unchanged if nothing is above `least`). Score: the sum of
    level 0 of `pyramid` over the points. Ties: the first in the fixed order of the search.
    taken, apart: shifts within `apart` cells of the one in `taken` (3,) int64 are skipped; -1: none are.
    """
    top = pyramid.shape[0] - 1
    stride = 1 << top
    across = (2 * side) // stride + 1
    turns = places.shape[0]
    bounds = np.empty(turns * across * across, np.float32)
    at = 0
    for k in range(turns):
        for a in range(across):
            for b in range(across):
                bounds[at] = _total(places, k, a * stride - side, b * stride - side, top, pyramid, pad)
                at += 1
    order = np.argsort(-bounds, kind="mergesort")
    stack = np.empty((3 * top + 4, 4), np.int64)
    scores = np.empty(3 * top + 4, np.float32)
    children = np.empty((4, 2), np.int64)
    marks = np.empty(4, np.float32)
    for start in order:
        if bounds[start] <= least:
            break
        k = start // (across * across)
        rest = start - k * across * across
        stack[0, 0], stack[0, 1], stack[0, 2] = k, (rest // across) * stride - side, (rest % across) * stride - side
        stack[0, 3], scores[0] = top, bounds[start]
        depth = 1
        while depth > 0:
            depth -= 1
            if scores[depth] <= least:
                continue
            row, column, level = stack[depth, 1], stack[depth, 2], stack[depth, 3]
            if level == 0:
                if abs(row - taken[1]) <= apart and abs(column - taken[2]) <= apart:
                    continue
                least = scores[depth]
                best[0], best[1], best[2] = k, row, column
                continue
            half = 1 << (level - 1)
            count = 0
            for child in range(4):
                r, c = row + (child >> 1) * half, column + (child & 1) * half
                if r > side or c > side:
                    continue
                bound = _total(places, k, r, c, level - 1, pyramid, pad)
                if bound <= least:
                    continue
                slot = count
                while slot > 0 and marks[slot - 1] > bound:
                    marks[slot] = marks[slot - 1]
                    children[slot, 0], children[slot, 1] = children[slot - 1, 0], children[slot - 1, 1]
                    slot -= 1
                marks[slot], children[slot, 0], children[slot, 1] = bound, r, c
                count += 1
            for child in range(count):
                stack[depth, 0], stack[depth, 1], stack[depth, 2] = k, children[child, 0], children[child, 1]
                stack[depth, 3], scores[depth] = level - 1, marks[child]
                depth += 1
    return least
