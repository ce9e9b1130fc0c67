# SPDX-License-Identifier: Apache-2.0
"""The exact Euclidean distance transform of a box of cells, kept up to date as cells become obstacles or cease to be.

Felzenszwalb and Huttenlocher 2012, Distance Transforms of Sampled Functions: axis by axis.
Our own, because SciPy and OpenCV only redo the whole box (20 to 51 ms, not 2.5 to 6.6:
`benchmarks/distance.py`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import in_shards
from stereovox.products import _transform

LANES = 32
"""Rows are padded to a multiple of this: whole vectors."""
MAX_CELLS, MAX_SIDE = 2**28, 2**14
"""Longest side of a box, in cells."""
UNLIMITED = np.float32(3e38)


class Field(NamedTuple):
    """The arrays of a transform as kernels take them. Axes by length: slabs a, rows b, and lanes c with padding.

    mask: (a, b, c) uint8, 1 for obstacles.
    runs: (a, b, c) int16 rows to the nearest obstacle of the same slab and lane.
    partial: (b, a, c) float32 squares to the nearest in the same slab.
    gone: earlier values of `partial` that were smaller, else infinite; valid only where `touched`.
    squares: (b, a, c) float32 to the nearest of all. metres: the same as distances.
    lowest, highest: (b, a) of `partial`, of `squares`.
    touched: (b, a) least square that changed in `partial`, before or after; -1 if none did.
    """

    mask: NDArray[np.uint8]
    runs: NDArray[np.int16]
    partial: NDArray[np.float32]
    superseded: NDArray[np.float32]
    squares: NDArray[np.float32]
    metres: NDArray[np.float32]
    lowest: NDArray[np.float32]
    highest: NDArray[np.float32]
    touched: NDArray[np.float32]


class Costs(NamedTuple):
    """The square by offset in cells, for each axis, in units of `unit` metres; lanes: for both directions.

    none: the square for no obstacle.
    """

    across: NDArray[np.float32]
    along: NDArray[np.float32]
    lanes: NDArray[np.float32]
    none: np.float32
    unit: np.float32


class Transform:
    """Distances in a box of `shape` (3,) cells with `sides` (3,) in metres; initially without obstacles.

    max_distance: metres, to one part in a million; obstacles farther away are ignored.
    nearer: cells by which obstacles count as nearer along each axis: 0 from centre to centre of cells, 0.5 from the
    centre to the nearest face, 1 from the nearest of all points of a cell; more as if all obstacles were larger by the
    rest.
    order: the axes from the longest to the shortest. field: the arrays, whose axes are in that order.
    """

    def __init__(self, shape: tuple[int, ...], sides: ArrayLike, max_distance: float, nearer: float = 0.0):
        _check(shape, max_distance)
        self.order = tuple(np.argsort([-n for n in shape], kind="stable").tolist())
        self._sides = np.array(sides, float)[list(self.order)]
        slabs, rows, self.lanes = (shape[axis] for axis in self.order)
        self.costs = self._costs((slabs, rows, -(-self.lanes // LANES) * LANES), max_distance, nearer)
        self.field = self._empty(slabs, rows)

    def update(self, dirty: NDArray[np.uint8], threads: int = 1) -> None:
        """Update `field` after its mask changed in the slabs marked in `dirty` (slabs,)."""

        def in_slabs(part: slice) -> None:
            _transform.across_slabs(self.field, self.costs, self.lanes, dirty, part.start, threads)

        def in_planes(part: slice) -> None:
            _transform.across_planes(self.field, self.costs, part.start, threads)

        interleaved = [slice(n, None) for n in range(threads)]  # changes are close together
        in_shards(in_slabs, interleaved)
        in_shards(in_planes, interleaved)

    @property
    def metres(self) -> NDArray[np.float32]:
        """Distances of all cells in metres, with the box's axes, infinite if there is no obstacle; a view."""
        return self.as_box(self.field.metres.swapaxes(0, 1))

    def as_box(self, cells: NDArray) -> NDArray:
        """Return an array (slabs, rows, padded lanes) with the axes of the box, a view."""
        return cells[:, :, : self.lanes].transpose(np.argsort(self.order))

    def _costs(self, shape: tuple[int, int, int], max_distance: float, nearer: float) -> Costs:
        unit = float(self._sides.min())
        across, along, lanes = (
            (np.maximum(np.arange(n) - nearer, 0) * side / unit) ** 2
            for n, side in zip(shape, self._sides, strict=True)
        )
        both = np.concatenate([lanes[:0:-1], lanes])
        both = np.pad(both, (1, 0), constant_values=np.inf)  # an even number: the middle is at half of it
        reach = (1 + 1e-6) * (max_distance / unit) ** 2
        none = UNLIMITED if reach > UNLIMITED else np.nextafter(np.float32(reach), np.float32(np.inf))
        across, along, both = (array.astype(np.float32) for array in (across, along, both))
        return Costs(across, along, both, np.float32(none), np.float32(unit))

    def _empty(self, slabs: int, rows: int) -> Field:
        padded, none = self.costs.lanes.size // 2, self.costs.none
        mask, runs = np.zeros((slabs, rows, padded), np.uint8), np.full((slabs, rows, padded), _transform.FAR)
        squares = np.zeros((rows, slabs, padded), np.float32)  # zero in the padding: nothing to search there
        squares[:, :, : self.lanes] = none
        superseded, metres = np.empty_like(squares), np.full_like(squares, np.inf)
        lowest, touched = np.full((rows, slabs), none), np.full((rows, slabs), _transform.UNCHANGED)
        return Field(mask, runs, squares, superseded, squares.copy(), metres, lowest, lowest.copy(), touched)


def transformed(
    mask: NDArray[np.bool_], sides: ArrayLike, max_distance: float = np.inf, nearer: float = 0.0
) -> NDArray[np.float32]:
    """Return the distance (x, y, z) float32 in metres of each cell to the nearest one in `mask` (x, y, z) bool.

    sides: of a cell, (3,) metres. Infinite if none is near enough. max_distance, nearer: see `Transform`.
    """
    transform = Transform(mask.shape, sides, max_distance, nearer)
    transform.field.mask[:, :, : transform.lanes] = mask.transpose(transform.order)
    transform.update(np.ones(len(transform.field.mask), np.uint8))
    return transform.metres


def _check(shape: tuple[int, ...], max_distance: float) -> None:
    if not max_distance > 0:
        raise StereovoxError(f"max_distance {max_distance:g}: give a length of more than 0 m")
    if np.prod(np.array(shape, float)) > MAX_CELLS or max(shape) > MAX_SIDE:
        sizes = " x ".join(map(str, shape))
        raise StereovoxError(f"a box of {sizes} cells is too large for a distance field; choose a smaller one")
