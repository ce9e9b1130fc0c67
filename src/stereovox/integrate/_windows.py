# SPDX-License-Identifier: Apache-2.0
"""Kernels that make the window images: at each pixel the farthest depth within a window, for windows of all sizes.

Level 0 is the depth image itself, level l >= 1 holds, for each tile of 2^(l-1) pixels, the farthest depth in the
3x3 tiles around it. For fast culling each level also has the nearest and farthest value of tiles of 16 and 64 of its
own pixels. No value is 0, so it is the nearest of all and never clears anything.
"""

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import NO_RETURN, ZERO, usable


@kernel
def build(depth_m, base, window, row, low_row, lows, highs, shape, offset, tile_offset, tile_width, first):
    """Fill window images and tiles of all levels from `first` on; return the farthest depth of the image.

    depth_m: flat REP 117 depth image. window: flat images of all levels, level l from offset[l] on with shape[l] rows
    and columns. base: scratch for the images before dilation; row, low_row: scratch of one row.
    lows, highs: flat tile images, at tile_offset[level, 0] for tiles of 16 and [level, 1] for 64.
    """
    height, width = shape[0, 0], shape[0, 1]
    if first <= 1:
        for i in range(height * width):
            window[i] = usable(depth_m[i])
    if first == 0:
        _tiles(window[: height * width], row, low_row, lows, highs, shape[0], tile_offset[0], tile_width[0])
    source = window
    for level in range(1, shape.shape[0]):
        if level > 1:
            target = base[offset[level] :]
            if level == 2 and first > 1:
                _halve(depth_m, height, width, target, shape[level, 1])
            else:
                _halve(source, height, width, target, shape[level, 1])
            source, height, width = target, shape[level, 0], shape[level, 1]
        if level >= first:
            image = window[offset[level] : offset[level] + height * width]
            _dilate(source, height, width, image, row)
            _tiles(image, row, low_row, lows, highs, shape[level], tile_offset[level], tile_width[level])
    top = shape.shape[0] - 1
    farthest = ZERO
    for i in range(tile_offset[top, 0], tile_offset[top, 1]):
        farthest = max(farthest, highs[i])
    return farthest


@cell
def _halve(source, height, width, target, target_width):
    for v in range((height + 1) // 2):
        upper = source[2 * v * width : (2 * v + 1) * width]
        lower = source[min(2 * v + 1, height - 1) * width : (min(2 * v + 1, height - 1) + 1) * width]
        out = target[v * target_width : (v + 1) * target_width]
        for u in range(width // 2):
            a = max(usable(upper[2 * u]), usable(upper[2 * u + 1]))
            b = max(usable(lower[2 * u]), usable(lower[2 * u + 1]))
            out[u] = max(a, b)
        if width % 2:
            out[target_width - 1] = max(usable(upper[width - 1]), usable(lower[width - 1]))


@cell
def _dilate(source, height, width, target, row):
    for v in range(height):
        above = source[max(v - 1, 0) * width : (max(v - 1, 0) + 1) * width]
        here = source[v * width : (v + 1) * width]
        below = source[min(v + 1, height - 1) * width : (min(v + 1, height - 1) + 1) * width]
        out = target[v * width : (v + 1) * width]
        for u in range(width):
            row[u] = max(max(above[u], below[u]), here[u])
        for u in range(1, width - 1):
            out[u] = max(max(row[u - 1], row[u + 1]), row[u])
        out[0] = max(row[0], row[min(1, width - 1)])
        out[width - 1] = max(row[width - 1], row[max(width - 2, 0)])


@cell
def _tiles(image, row, low_row, lows, highs, shape, tile_offset, tile_width):
    height, width = shape[0], shape[1]
    _fill_big(lows, highs, tile_offset[1], tile_width[1] * ((height + 63) // 64))
    for tv in range((height + 15) // 16):
        _extremes_of_rows(image, 16 * tv, min(16 * tv + 16, height), width, row, low_row)
        for tu in range(tile_width[0]):
            low, high = NO_RETURN, ZERO
            for u in range(16 * tu, min(16 * tu + 16, width)):
                low = min(low, low_row[u])
                high = max(high, row[u])
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
def _extremes_of_rows(image, first, last, width, high_row, low_row):
    for u in range(width):
        high_row[u] = ZERO
        low_row[u] = NO_RETURN
    for v in range(first, last):
        line = image[v * width : (v + 1) * width]
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
