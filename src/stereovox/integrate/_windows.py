# SPDX-License-Identifier: Apache-2.0
"""Kernels that build window images: at each pixel the farthest depth within a window, for windows of all sizes.

Level 0 is the depth image itself, level l >= 1 holds, for each tile of 2^(l-1) pixels, the farthest depth in the
3x3 tiles around it. For fast culling each level also has the nearest and farthest value of tiles of 16 and 64 of its
own pixels. No value is 0, so it is the nearest of all and never clears anything.

All levels stand in one image whose rows are `pitch` long: level 1 on top, level 0 below it, the others side by side
below that; so the place of a pixel takes a few sums and no table look-up (`place`).
"""

import numpy as np

from stereovox._jit import cell
from stereovox.integrate._cells import NO_RETURN, ZERO, float_of, usable

COARSEST = 8
"""The highest level."""


@cell
def place(level, v, u, pitch, height):
    """Return where the window value at row v, column u of the depth image stands, for a level from 0 to COARSEST.

    v, u: float32, rounded down. All else, and what is returned, is int32: shifts by a variable would take 64 bits.
    """
    halvings = max(np.int32(level - np.int32(1)), np.int32(0))
    scale = float_of(np.int32(np.int32(np.int32(127) - halvings) * np.int32(1 << 23)))  # 2^-halvings
    wide, below = np.float32(np.int32(pitch + pitch)), np.int32(height * pitch)
    beside = np.int32(pitch - np.int32(wide * scale))  # where the levels from 2 on start in their rows
    level_0_or_1 = below if level == 0 else np.int32(0)
    start = np.int32(np.int32(below + below) + beside) if halvings > 0 else level_0_or_1
    return np.int32(start + np.int32(np.int32(np.int32(v * scale) * pitch) + np.int32(u * scale)))


@cell
def build(depth_m, windows, scratch):
    """Fill the window images and tiles (`Windows`) of all levels from `windows.first` on; return the farthest depth.

    depth_m: flat REP 117 depth image. scratch: `WindowScratch`.
    """
    window, lows, highs, shape = windows.image, windows.lows, windows.highs, windows.shape
    tile_offset, tile_width, first = windows.tile_offset, windows.tile_width, windows.first
    base, ring = scratch.base, scratch.ring
    row, other, high_row, low_row = scratch.row, scratch.other, scratch.high_row, scratch.low_row
    height, width, pitch = shape[0, 0], shape[0, 1], np.int32(row.size)
    lowest = max(first, 1)
    for level in range(first, COARSEST + 1):
        rows, columns = shape[level, 0], shape[level, 1]
        start = place(np.int32(level), ZERO, ZERO, pitch, height)
        coarser = place(np.int32(level + 1), ZERO, ZERO, pitch, height)
        _fill_big(lows, highs, tile_offset[level, 1], tile_width[level, 1] * ((rows + 63) >> 6))
        for v in range(rows + 1):
            here = ring[v & 3]
            if v < rows:
                if level <= lowest:
                    _shrunk_row(depth_m, v, height, width, max(level - 1, 0), row, other, here)
                else:
                    _copy(base[start + v * pitch :], columns, here)
                if 0 < level < COARSEST and (v % 2 == 1 or v == rows - 1):
                    _halved_rows(ring[v & 2], here, columns, row, base[coarser + (v >> 1) * pitch :])
            if v > 0:
                out = window[start + (v - 1) * pitch :]
                if level == 0:
                    _copy(ring[(v - 1) & 3], columns, out)
                else:
                    _window_row(
                        ring[max(v - 2, 0) & 3], ring[(v - 1) & 3], ring[min(v, rows - 1) & 3], columns, row, out
                    )
                _take_in(out, columns, v - 1, high_row, low_row)
                if v % 16 == 0 or v == rows:
                    offsets = tile_offset[level, 0] + ((v - 1) >> 4) * tile_width[level, 0]
                    big = tile_offset[level, 1] + ((v - 1) >> 6) * tile_width[level, 1]
                    _most_of_16(low_row, columns, other)
                    _most_of_16(high_row, columns, other)
                    _put(low_row, tile_width[level, 0], lows, offsets, big, False)
                    _put(high_row, tile_width[level, 0], highs, offsets, big, True)
    farthest = ZERO
    for i in range(tile_offset[COARSEST, 0], tile_offset[COARSEST, 1]):
        farthest = max(farthest, highs[i])
    return farthest


@cell
def _copy(source, width, out):
    for u in range(width):
        out[u] = source[u]


@cell
def _shrunk_row(depth_m, v, height, width, halvings, row, other, out):
    """Write to `out` the farthest depth in each tile of 2^halvings pixels of row v of tiles."""
    first = v << halvings
    if halvings == 0:
        depths = depth_m[first * width :]
        for u in range(width):
            out[u] = usable(depths[u])
        return
    for u in range(width):
        row[u] = ZERO
    for line in range(first, min(first + (1 << halvings), height)):
        depths = depth_m[line * width :]
        for u in range(width):
            row[u] = max(row[u], depths[u])  # what is not a number is never the larger one
    size = width
    for halving in range(halvings):
        if halving % 2:
            _halved_row(other, size, row)
        else:
            _halved_row(row, size, other)
        size = (size + 1) >> 1
    shrunk = other if halvings % 2 else row
    for u in range(size):
        out[u] = min(shrunk[u], NO_RETURN)


@cell
def _halved_rows(upper, lower, width, row, out):
    for u in range(width):
        row[u] = max(upper[u], lower[u])
    _halved_row(row, width, out)


@cell
def _halved_row(row, width, out):
    for u in range(width // 2):
        out[u] = max(row[2 * u], row[2 * u + 1])
    if width % 2:
        out[width // 2] = row[width - 1]


@cell
def _window_row(above, here, below, width, row, out):
    for u in range(width):
        row[u] = max(max(above[u], below[u]), here[u])
    for u in range(1, width - 1):
        out[u] = max(max(row[u - 1], row[u + 1]), row[u])
    out[0] = max(row[0], row[min(1, width - 1)])
    out[width - 1] = max(row[width - 1], row[max(width - 2, 0)])


@cell
def _take_in(line, width, v, high_row, low_row):
    """Take row v of window values into the highest, and the highest of their opposites, of up to 16 rows."""
    if v % 16 == 0:
        for u in range(width):
            high_row[u] = line[u]
            low_row[u] = -line[u]
        return
    for u in range(width):
        high_row[u] = max(high_row[u], line[u])
        low_row[u] = max(low_row[u], -line[u])


@cell
def _most_of_16(row, width, other):
    """Put the highest value of each 16 columns into the first ones of `row`."""
    for _ in range(2):
        _halved_row(row, width, other)
        _halved_row(other, (width + 1) >> 1, row)
        width = (width + 3) >> 2


@cell
def _put(row, number, tiles, start, big, highest):
    """Enter a row of tiles of 16, and take it into that of tiles of 64; where not `highest`, `row` holds opposites."""
    for tu in range(number):
        k = big + (tu >> 2)
        value = row[tu] if highest else -row[tu]
        tiles[start + tu] = value
        tiles[k] = max(tiles[k], value) if highest else min(tiles[k], value)


@cell
def _fill_big(lows, highs, start, number):
    for i in range(start, start + number):
        lows[i] = NO_RETURN
        highs[i] = ZERO


@cell
def nearest_tiles(depth_m, lows16, lows64):
    """Fill tiles (rows, columns) of 16 and 64 pixels with the nearest depth in them, pixels without value left out."""
    height, width = depth_m.shape
    lows64[:, :] = NO_RETURN
    for tv in range((height + 15) // 16):
        for tu in range((width + 15) // 16):
            low = NO_RETURN
            for v in range(16 * tv, min(16 * tv + 16, height)):
                for u in range(16 * tu, min(16 * tu + 16, width)):
                    d = depth_m[v, u]
                    low = min(low, d if d > ZERO else NO_RETURN)
            lows16[tv, tu] = low
            lows64[tv >> 2, tu >> 2] = min(lows64[tv >> 2, tu >> 2], low)
