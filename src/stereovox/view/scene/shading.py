# SPDX-License-Identifier: Apache-2.0
"""Ambient occlusion: faces are darker the more cells are in front of them, so that corners, gaps and contacts show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import Keys, keys, position

RADII = ((1, 0.15), (2, 0.3), (3, 0.4), (4, 0.6))
"""Radii in cells of the boxes before a face whose occupied share darkens it, and how strongly."""

BURIED = 0.6
"""Mean brightness of a cell without an exposed face, visible if cells are drawn coarser."""


class Occlusion:
    """Sky visibility of the faces of a set of cells.

    Args:
        cells: (N, 3) indices, none twice.
        radii: As `RADII`; without any, all faces see the whole sky.
    """

    def __init__(self, cells: NDArray[np.integer], radii: Sequence[tuple[int, float]] = RADII):
        self._radii = radii
        self._keys = keys(cells)
        self._sorted = np.sort(self._keys)
        self._found: dict[tuple[int, int], NDArray[np.float32]] = {}

    def brightness(self, axis: int, side: int) -> NDArray[np.float32]:
        """Return the brightness (N,) of the faces along `axis`, upper ones for side 1 and lower ones for -1.

        1: nothing is in front of the face. 0: a cell covers it.
        """
        if (axis, side) not in self._found:
            self._found[axis, side] = self._look(axis, side)
        return self._found[axis, side]

    def mean(self) -> NDArray[np.float32]:
        """Return the mean brightness (N,) of each cell's exposed faces, for uses with one colour per cell."""
        total, number = np.zeros(len(self._keys), np.float32), np.zeros(len(self._keys), np.float32)
        for axis in range(3):
            for side in (-1, 1):
                brightness = self.brightness(axis, side)
                total += brightness
                number += brightness > 0
        return np.where(number > 0, total / np.maximum(number, 1), BURIED).astype(np.float32)

    def _look(self, axis: int, side: int) -> NDArray[np.float32]:
        step = np.zeros(3, np.int64)
        step[axis] = side
        exposed = np.flatnonzero(position(self._keys + _shift(step), self._sorted) < 0)
        shade = np.zeros(len(exposed))
        for radius, weight in self._radii:
            low, high = np.full(3, -radius), np.full(3, radius)
            low[axis], high[axis] = (1, radius) if side > 0 else (-radius, -1)
            shade += weight * self._count(self._keys[exposed], low, high) / np.prod(high - low + 1)
        brightness = np.zeros(len(self._keys), np.float32)
        brightness[exposed] = np.exp(-shade)
        return brightness

    def _count(self, around: Keys, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of cells in a box around each key (n,); keys are consecutive along z."""
        number = np.zeros(len(around), np.int64)
        for dx in range(low[0], high[0] + 1):
            for dy in range(low[1], high[1] + 1):
                first, last = (_shift(np.array([dx, dy, z])) for z in (low[2], high[2]))
                number += np.searchsorted(self._sorted, around + last, "right")
                number -= np.searchsorted(self._sorted, around + first, "left")
        return number


def _shift(step: NDArray[np.integer]) -> int:
    """Return the change of a key by a step of (3,) cells."""
    cell, origin = keys(np.stack([step, np.zeros(3, np.int64)]))
    return int(cell - origin)
