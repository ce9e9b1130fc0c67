# SPDX-License-Identifier: Apache-2.0
"""Kernels that make the window images: at each pixel the farthest depth within a window, for windows of all sizes.

Level 0 is the depth image itself, level l >= 1 holds, for each tile of 2^(l-1) pixels, the farthest depth in the
3x3 tiles around it. For fast culling each level also has the nearest and farthest value of tiles of 16 and 64 of its
own pixels. No value is 0, so it is the nearest of all and never clears anything.

All levels stand in one image whose rows are `pitch` long: level 1 on top, level 0 below it, the others side by side
below that; so where a pixel stands takes a few sums, and no look at a table (`place`).
"""

import numpy as np

from stereovox._jit import cell, kernel
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


@kernel
def build(depth_m, base, window, row, other, lows, highs, shape, tile_offset, tile_width, pitch, first):
    """Fill window images and tiles of all levels from `first` on; return the farthest depth of the image.

    depth_m: flat REP 117 depth image. window: flat image of all levels; shape: (levels, 2) rows and columns of each.
    base: like `window`, scratch for the images before dilation; row, other: (pitch,) scratch.
    lows, highs: flat tile images, at tile_offset[level, 0] for tiles of 16 and [level, 1] for 64.
    """
    height, width = shape[0, 0], shape[0, 1]
    if first == 0:
        level_0 = window[place(np.int32(0), ZERO, ZERO, pitch, height) :]
        for v in range(height):
            _copy_row(depth_m[v * width : (v + 1) * width], level_0[v * pitch :])
        _tiles(level_0, pitch, row, other, lows, highs, shape[0], tile_offset[0], tile_width[0])
    lowest = max(first, 1)
    for level in range(lowest, COARSEST + 1):
        start = place(np.int32(level), ZERO, ZERO, pitch, height)
        target, image = base[start:], window[start:]
        if level == lowest:
            _shrink(depth_m, height, width, level - 1, row, other, target, pitch)
        else:
            finer = base[place(np.int32(level - 1), ZERO, ZERO, pitch, height) :]
            _halve(finer, shape[level - 1, 0], shape[level - 1, 1], row, target, pitch)
        _dilate(target, shape[level, 0], shape[level, 1], row, image, pitch)
        _tiles(image, pitch, row, other, lows, highs, shape[level], tile_offset[level], tile_width[level])
    farthest = ZERO
    for i in range(tile_offset[COARSEST, 0], tile_offset[COARSEST, 1]):
        farthest = max(farthest, highs[i])
    return farthest


@cell
def _copy_row(depths, out):
    for u in range(depths.size):
        out[u] = usable(depths[u])


@cell
def _shrink(depth_m, height, width, halvings, row, other, target, pitch):
    """Write to `target` the farthest depth in tiles of 2^halvings pixels."""
    tile = 1 << halvings
    for v in range(0, height, tile):
        out = target[(v >> halvings) * pitch :]
        if halvings == 0:
            _copy_row(depth_m[v * width : (v + 1) * width], out)
            continue
        for u in range(width):
            row[u] = ZERO
        for line in range(v, min(v + tile, height)):
            depths = depth_m[line * width : (line + 1) * width]
            for u in range(width):
                row[u] = max(row[u], depths[u])  # a NaN does not win: see `max`
        size = width
        for halving in range(halvings):
            if halving % 2:
                _halve_row(other, size, row)
            else:
                _halve_row(row, size, other)
            size = (size + 1) >> 1
        shrunk = other if halvings % 2 else row
        for u in range(size):
            out[u] = min(shrunk[u], NO_RETURN)


@cell
def _halve(source, height, width, row, target, pitch):
    for v in range((height + 1) // 2):
        upper, lower = source[2 * v * pitch :], source[min(2 * v + 1, height - 1) * pitch :]
        for u in range(width):
            row[u] = max(upper[u], lower[u])
        _halve_row(row, width, target[v * pitch :])


@cell
def _halve_row(row, width, out):
    for u in range(width // 2):
        out[u] = max(row[2 * u], row[2 * u + 1])
    if width % 2:
        out[width // 2] = row[width - 1]


@cell
def _dilate(source, height, width, row, target, pitch):
    for v in range(height):
        above, here, below = source[max(v - 1, 0) * pitch :], source[v * pitch :], source[min(v + 1, height - 1) * pitch :]
        out = target[v * pitch :]
        for u in range(width):
            row[u] = max(max(above[u], below[u]), here[u])
        for u in range(1, width - 1):
            out[u] = max(max(row[u - 1], row[u + 1]), row[u])
        out[0] = max(row[0], row[min(1, width - 1)])
        out[width - 1] = max(row[width - 1], row[max(width - 2, 0)])


@cell
def _tiles(image, pitch, high_row, low_row, lows, highs, shape, tile_offset, tile_width):
    height, width = shape[0], shape[1]
    _fill_big(lows, highs, tile_offset[1], tile_width[1] * ((height + 63) // 64))
    for tv in range((height + 15) // 16):
        _extremes_of_rows(image, pitch, 16 * tv, min(16 * tv + 16, height), width, high_row, low_row)
        for tu in range(tile_width[0]):
            low, high = NO_RETURN, ZERO
            for u in range(16 * tu, min(16 * tu + 16, width)):
                low = min(low, low_row[u])
                high = max(high, high_row[u])
            lows[tile_offset[0] + tv * tile_width[0] + tu] = low
            highs[tile_offset[0] + tv * tile_width[0] + tu] = high
            big = tile_offset[1] + (tv >> 2) * tile_width[1] + (tu >> 2)
            lows[big] = min(lows[big], low)
            highs[big] = max(highs[big], high)


@cell
def _fill_big(lows, highs, start, number):
    for i in range(start, start + number):
        lows[i] = NO_RETURN
        highs[i] = ZERO


@cell
def _extremes_of_rows(image, pitch, first, last, width, high_row, low_row):
    for u in range(width):
        high_row[u] = ZERO
        low_row[u] = NO_RETURN
    for v in range(first, last):
        line = image[v * pitch :]
        for u in range(width):
            high_row[u] = max(high_row[u], line[u])
            low_row[u] = min(low_row[u], line[u])


@kernel
def nearest_tiles(depth_m, height, width, lows16, lows64):
    """Fill tiles of 16 and 64 pixels with the nearest depth in them, pixels without value left out."""
    wide = (width + 63) // 64
    lows64[:] = NO_RETURN
    for tv in range((height + 15) // 16):
        for tu in range((width + 15) // 16):
            low = NO_RETURN
            for v in range(16 * tv, min(16 * tv + 16, height)):
                for u in range(16 * tu, min(16 * tu + 16, width)):
                    d = depth_m[v * width + u]
                    low = min(low, d if d > ZERO else NO_RETURN)
            lows16[tv * ((width + 15) // 16) + tu] = low
            big = (tv >> 2) * wide + (tu >> 2)
            lows64[big] = min(lows64[big], low)
