# SPDX-License-Identifier: Apache-2.0
"""A tree of boxes round triangles, and the first triangle that rays meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.simulate import _rays

LEAF = 4
"""Most triangles of a leaf."""
MAX_LEVELS = 64
"""Most boxes that wait while rays descend one side of the tree: one per level."""


class TriangleTree:
    """Triangles (M, 3, 3) float64 in metres, at least one and all finite, sorted into a balanced tree.

    On each level a box's triangles are split into two halves of equal number along the axis that minimises the
    halves' surfaces (Goldsmith and Salmon 1987), since rays meet a box in proportion to its surface.
    """

    def __init__(self, triangles: NDArray[np.float64]):
        levels = max(int(np.ceil(np.log2(len(triangles) / LEAF))), 0)
        low, high = triangles.min(1), triangles.max(1)
        self._order = _sorted(low, high, levels)
        self._triangles = np.ascontiguousarray(triangles[self._order], np.float64)
        self._starts = _bounds(len(triangles), levels).astype(np.int32)
        self._boxes = _boxes(low[self._order], high[self._order], self._starts)

    def nearest(
        self, origin: NDArray[np.float64], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return the distance from `origin` (3,) to the first triangle in units of `directions` (N, 3), and its number.

        float32, inf if there is none; int32, -1 if there is none. A triangle without area is never met, and a
        ray on the side of two always meets one of them. Releases the GIL.
        """
        share, number = np.empty(len(directions), np.float32), np.empty(len(directions), np.int32)
        sides, planes = np.empty((len(self._order), 9)), np.empty((len(self._order), 4))
        _rays.look(self._triangles, origin, sides, planes)
        _rays.nearest(
            np.ascontiguousarray(directions, np.float32),
            (self._boxes - np.tile(origin, 2)).astype(np.float32),
            self._starts,
            sides,
            planes,
            np.empty((7, _rays.LANES), np.float32),
            np.empty(_rays.LANES, np.int32),
            np.empty(MAX_LEVELS, np.int32),
            share,
            number,
        )
        return share, np.where(number < 0, np.int32(-1), self._order[number])


def _bounds(count: int, level: int) -> NDArray[np.int64]:
    """Return the starts of the 2 ** level parts of `count` sorted triangles, and the end."""
    return count * np.arange(2**level + 1) >> level


def _sorted(low: NDArray[np.float64], high: NDArray[np.float64], levels: int) -> NDArray[np.int32]:
    """Return the order (M,) that keeps the triangles of each box together, on all levels."""
    middle = low + high
    order = np.arange(len(low), dtype=np.int32)
    for level in range(levels):
        box = np.repeat(np.arange(2**level), np.diff(_bounds(len(order), level)))
        halves = _bounds(len(order), level + 1)[:-1]
        along = [order[np.lexsort((middle[order, axis], box))] for axis in range(3)]
        cost = [
            _surface(np.minimum.reduceat(low[way], halves), np.maximum.reduceat(high[way], halves)) for way in along
        ]
        best = np.reshape(cost, (3, -1, 2)).sum(2).argmin(0)
        order = np.choose(best[box], along)
    return order


def _surface(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half the surface of boxes (N, 3)."""
    x, y, z = (high - low).T
    return x * y + y * z + z * x


def _boxes(low: NDArray[np.float64], high: NDArray[np.float64], starts: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the lowest and highest corner (nodes, 6) of all nodes: 0 is unused, 1 all, 2 and 3 its halves, and so
    on."""
    levels = [(np.minimum.reduceat(low, starts[:-1]), np.maximum.reduceat(high, starts[:-1]))]
    while len(levels[0][0]) > 1:
        low, high = levels[0]
        levels.insert(0, (np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])))
    return np.concatenate([np.zeros((1, 6)), *map(np.hstack, levels)])
