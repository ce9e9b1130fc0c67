# SPDX-License-Identifier: Apache-2.0
"""Kernel that looks down the columns of a map's blocks."""

import numpy as np

from stereovox._jit import kernel

SIDE, NOTHING = 8, np.int16(-(2**15))


@kernel
def look_down(coords, values, order, corner, layers, unknown, free_below, marked, cleared):
    """Raise each cell of a floor to what stands in its column: blocks (n, 3), their cells (n, 512) as stored.

    order: which axes of the map go along columns, along rows and up; corner: lowest cell along the first two.
    layers: first and last along the third whose largest number goes to `marked`; the largest of any that is less than
    `free_below` goes to `cleared`. Both (rows, columns) int16.
    """
    across, away, upwards = SIDE ** (2 - order[0]), SIDE ** (2 - order[1]), SIDE ** (2 - order[2])
    for n in range(coords.shape[0]):
        column = coords[n, order[0]] * SIDE - corner[0]
        row = coords[n, order[1]] * SIDE - corner[1]
        bottom = coords[n, order[2]] * SIDE
        first, last = max(layers[0] - bottom, 0), min(layers[1] - bottom, SIDE - 1)
        for i in range(SIDE):
            for j in range(SIDE):
                highest, free = marked[row + j, column + i], cleared[row + j, column + i]
                for k in range(SIDE):  # selects: nobody can foretell branches here
                    number = np.int16(values[n, i * across + j * away + k * upwards])
                    inside = (number != unknown) & (k >= first) & (k <= last)
                    clears = (number != unknown) & (number < free_below)
                    highest = max(highest, number if inside else NOTHING)
                    free = max(free, number if clears else NOTHING)
                marked[row + j, column + i], cleared[row + j, column + i] = highest, free
