# SPDX-License-Identifier: Apache-2.0
"""Kernels that build window images: how far one sees through the pixels around a point, for windows of all sizes.

Level 0 is the depth image itself; level l >= 1 holds, for each tile of 2^(l-1) pixels, the farthest of the 3x3 tiles
around it. One sees through a tile as far as its nearest pixel (`_shrink`). Next to an edge or a hole depths are often
wrong and thin things are missed, so cells larger than about four pixels are cleared only by patches that see through as
a whole, smaller ones by single pixels. A second image of the same layout, `clear`, holds up to which depth an area
about twice as wide, the 3x3 tiles of the next level, is plainly free as a whole: a cell that is seen through but lies
farther is next to an edge. It is left out if `edge_share` is 1. For fast culling each level also has the least clear
depth, or window value, and the farthest window value of tiles of 16 and 64 of its own pixels. A missing value is 0: the
nearest of all, which never clears anything. All levels share one image whose rows are `pitch` long: level 1 on top,
level 0 below it, the others side by side below that; so the index of a pixel takes a few sums and no table look-up
(`place`).
"""

import numpy as np

from stereovox.integrate._cells import NO_RETURN, ONE, ZERO, float_of, table_row, usable
from stereovox.kernels._jit import cell

COARSEST = 8
"""The highest level."""
TWO = np.float32(2)


@cell
def place(level, v, u, pitch, height):
    """Return the index of the window value at row v, column u of the depth image, for a level from 0 to COARSEST.

    v, u: float32, rounded down. All else, and the result, is int32: shifts by a variable would take 64 bits.
    """
    halvings = max(np.int32(level - np.int32(1)), np.int32(0))
    scale = float_of(np.int32(np.int32(np.int32(127) - halvings) * np.int32(1 << 23)))  # 2^-halvings
    wide, below = np.float32(np.int32(pitch + pitch)), np.int32(height * pitch)
    beside = np.int32(pitch - np.int32(wide * scale))  # start of the levels from 2 on in their rows
    level_0_or_1 = below if level == 0 else np.int32(0)
    start = np.int32(np.int32(below + below) + beside) if halvings > 0 else level_0_or_1
    return np.int32(start + np.int32(np.int32(np.int32(v * scale) * pitch) + np.int32(u * scale)))


@cell
def build(depth_m, windows, table, scratch):
    """Fill the window images and tiles (`Windows`) of all levels from `windows.first` on; return the farthest depth.

    depth_m: flat REP 117 depth image. table: `KernelTable`. scratch: `WindowScratch`.
    """
    lows, highs, shape = windows.lows, windows.highs, windows.shape
    tile_offset, tile_width, first = windows.tile_offset, windows.tile_width, windows.first
    base, row, other, high_row, low_row = scratch
    height, pitch = shape[0, 0], np.int32(row.size)
    _shrink(depth_m, shape, base, pitch, row, other)
    for level in range(first, COARSEST + 1):
        rows, columns = shape[level, 0], shape[level, 1]
        start = place(np.int32(level), ZERO, ZERO, pitch, height)
        _fill_big(lows, highs, tile_offset[level, 1], tile_width[level, 1] * ((rows + 63) >> 6))
        for v in range(rows):
            line = slice(start + v * pitch, start + v * pitch + columns)
            out, clear = windows.image[line], windows.clear[line]
            above, here, below = _three_rows(base, shape, pitch, max(level, 1), v)
            if level == 0:
                _copy(here, columns, out)
            else:
                _farthest_of_three(above, here, below, columns, row, out)
            if not table.edges:
                clear = out
            else:
                if next_is_coarser(level):
                    if v % 2 == 0:
                        above, here, below = _three_rows(base, shape, pitch, level + 1, v >> 1)
                        _clear_of_three(above, here, below, shape[level + 1, 1], table, row, other)
                    _doubled(other, columns, clear)
                else:
                    _clear_of_three(above, here, below, columns, table, row, clear)
                _not_through(out, columns, clear)
            _take_in(out, clear, columns, v, high_row, low_row)
            if v % 16 == 15 or v == rows - 1:
                offsets = tile_offset[level, 0] + (v >> 4) * tile_width[level, 0]
                big = tile_offset[level, 1] + (v >> 6) * tile_width[level, 1]
                _most_of_16(low_row, columns, other)
                _most_of_16(high_row, columns, other)
                _put(low_row, tile_width[level, 0], lows, offsets, big, False)
                _put(high_row, tile_width[level, 0], highs, offsets, big, True)
    return farthest_of(windows)


@cell
def next_is_coarser(level):
    """Return whether the tiles of a level are half as wide as those of the next; both of level 0 and 1 are pixels."""
    return (level > 0) & (level < COARSEST)


@cell
def farthest_of(windows):
    """Return the farthest value of all window images, which is in the finest one."""
    first, farthest = windows.first, ZERO
    start = windows.tile_offset[first, 1]
    for i in range(start, start + windows.tile_width[first, 1] * ((windows.shape[first, 0] + 63) >> 6)):
        farthest = max(farthest, windows.highs[i])
    return farthest


@cell
def _shrink(depth_m, shape, base, pitch, near, known):
    """Write how far one sees through each tile of the levels from 1 on to `base`, laid out like the window images.

    A tile has four parts, of the previous level: one sees through it as far as its nearest value, and not at all
    (`seen_through`) if most parts have none. At the border tiles end with the image: its last row and column count
    twice.
    near, known: (pitch,) scratch.
    """
    height = shape[0, 0]
    for v in range(height):
        line, out = depth_m[v * shape[1, 1] :], base[v * pitch :]
        for u in range(shape[1, 1]):
            out[u] = usable(line[u])
    for level in range(2, COARSEST + 1):
        rows, columns = shape[level - 1, 0], shape[level - 1, 1]
        start = place(np.int32(level - 1), ZERO, ZERO, pitch, height)
        target = place(np.int32(level), ZERO, ZERO, pitch, height)
        for v in range(shape[level, 0]):
            upper = base[start + 2 * v * pitch :]
            lower = base[start + min(2 * v + 1, rows - 1) * pitch :]
            out = base[target + v * pitch :]
            for u in range(columns):
                near[u] = min(nearness(upper[u]), nearness(lower[u]))
                known[u] = (ONE if upper[u] > ZERO else ZERO) + (ONE if lower[u] > ZERO else ZERO)
            for u in range(columns // 2):
                out[u] = seen_through(min(near[2 * u], near[2 * u + 1]), known[2 * u] + known[2 * u + 1])
            if columns % 2:
                u = columns - 1
                out[u // 2] = seen_through(near[u], known[u] + known[u])


@cell
def nearness(depth):
    """Return the nearest depth in a tile for taking minima, seen through or not; without any value NO_RETURN."""
    return min(abs(depth), NO_RETURN) if depth != ZERO else NO_RETURN


@cell
def seen_through(nearest, known):
    """Return how far one sees through a tile with `known` parts of four that one sees through.

    Negative: not at all, and the nearest value in it; 0 without any.
    """
    blocked = -nearest if nearest < NO_RETURN else ZERO
    return nearest if known >= TWO else blocked


@cell
def _three_rows(base, shape, pitch, level, v):
    """Return row v of a level of `base`, the one above and the one below; at the border that row itself."""
    start = place(np.int32(level), ZERO, ZERO, pitch, shape[0, 0])
    above, below = max(v - 1, 0), min(v + 1, shape[level, 0] - 1)
    return base[start + above * pitch :], base[start + v * pitch :], base[start + below * pitch :]


@cell
def _copy(source, width, out):
    for u in range(width):
        out[u] = source[u]


@cell
def _doubled(source, width, out):
    """Write each value to two columns."""
    for u in range(width // 2):
        out[2 * u] = source[u]
        out[2 * u + 1] = source[u]
    if width % 2:
        out[width - 1] = source[width // 2]


@cell
def _halved_row(row, width, out):
    for u in range(width // 2):
        out[u] = max(row[2 * u], row[2 * u + 1])
    if width % 2:
        out[width // 2] = row[width - 1]


@cell
def _farthest_of_three(above, here, below, width, row, out):
    """Write the farthest of each 3x3 values, 0 if one sees through none; at the border of those inside."""
    for u in range(width):
        row[u] = max(max(max(above[u], below[u]), here[u]), ZERO)
    for u in range(1, width - 1):
        out[u] = max(max(row[u - 1], row[u + 1]), row[u])
    out[0] = max(row[0], row[min(1, width - 1)])
    out[width - 1] = max(row[width - 1], row[max(width - 2, 0)])


@cell
def _clear_of_three(above, here, below, width, table, row, out):
    """Write up to which depth all that was measured in each 3x3 tiles is plainly free."""
    for u in range(width):
        row[u] = min(min(nearness(above[u]), nearness(below[u])), nearness(here[u]))
    for u in range(1, width - 1):
        out[u] = min(min(row[u - 1], row[u + 1]), row[u])
    out[0] = min(row[0], row[min(1, width - 1)])
    out[width - 1] = min(row[width - 1], row[max(width - 2, 0)])
    for u in range(width):
        out[u] = clear_to(table, out[u])


@cell
def _not_through(line, width, clear):
    """Make nothing clear through windows without value."""
    for u in range(width):
        clear[u] = clear[u] if line[u] > ZERO else ZERO


@cell
def clear_to(table, depth):
    """Return the z up to which every measurement of at least `depth` gives plain free space."""
    if depth <= ZERO:
        return ZERO
    if depth >= NO_RETURN:
        return NO_RETURN
    row = table_row(depth, table.rows_per_metre, table.hit.size)
    return min(depth - table.reach[row], table.safe[row + 1])


@cell
def _take_in(line, clear, width, v, high_row, low_row):
    """Merge row v into the maxima of up to 16 rows, of the window values and of the negatives of the clear depths."""
    if v % 16 == 0:
        for u in range(width):
            high_row[u] = line[u]
            low_row[u] = -clear[u]
        return
    for u in range(width):
        high_row[u] = max(high_row[u], line[u])
        low_row[u] = max(low_row[u], -clear[u])


@cell
def _most_of_16(row, width, other):
    """Write the highest value of each 16 columns to the start of `row`."""
    for _ in range(2):
        _halved_row(row, width, other)
        _halved_row(other, (width + 1) >> 1, row)
        width = (width + 3) >> 2


@cell
def _put(row, number, tiles, start, big, highest):
    """Write a row of tiles of 16, and merge it into the tiles of 64; unless `highest`, `row` holds negatives."""
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
    """Fill tiles (rows, columns) of 16 and 64 pixels with their nearest depth, ignoring pixels without value."""
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
