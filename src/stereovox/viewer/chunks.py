# SPDX-License-Identifier: Apache-2.0
"""Level of detail: cells of one kind in the viewer, full size near a viewpoint and coarser far away.

A browser draws several hundred thousand cubes smoothly, and a map may have millions of cells. They are split into
chunks; each is sent with cells of 1, 2, 4 ... times the side, as coarse as is barely visible, and coarser if there are
still too many. Only changes are sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from viser import SceneNodeHandle, ViserServer

CHUNK_BITS = 6
SIDE = 1 << CHUNK_BITS
"""Cells along a side of a chunk."""
COARSEST = 4
"""Largest number of doublings of a cell's side."""
MAX_CELLS = 250_000
"""Default for the approximate number of cells of one kind that are sent at once."""
ANGLE = 0.002
"""A cell that appears smaller than this angle in radians, about two pixels, may be drawn coarser."""
WIDER = 1.25
HALF = 1 << 20
"""Indices of cells are between -HALF and HALF."""
Key = tuple[int, int, int]


class Draws(Protocol):
    """Adds cells to a scene: centres (N, 3) in metres, colours (N, 3) uint8, side in metres."""

    def __call__(
        self, server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
    ) -> SceneNodeHandle:
        """Return the node, which replaces one with the same name."""
        ...


class Chunk:
    """Cells of one chunk: indices (N, 3) int32, colours (N, 3) uint8; sent: number of doublings as sent, or None."""

    def __init__(self, cells: NDArray[np.int32], colours: NDArray[np.uint8]):
        self.cells, self.colours = cells, colours
        self.sent: int | None = None
        self.node: SceneNodeHandle | None = None

    def is_like(self, other: Chunk) -> bool:
        """Return whether both are equal."""
        return np.array_equal(self.cells, other.cells) and np.array_equal(self.colours, other.colours)


class Chunks:
    """All cells of one kind. name: of the scene node, below which each chunk has its own.

    size: side of a cell in metres. most: approximate number of cells sent at once. chunks: by place, in chunks from the
    origin.
    """

    def __init__(self, server: ViserServer, name: str, size: float, draws: Draws, max_cells: int = MAX_CELLS):
        self.chunks: dict[Key, Chunk] = {}
        self._server, self._name, self._size, self._draws, self._max_cells = server, name, size, draws, max_cells
        self.root = server.scene.add_frame(name, show_axes=False)

    @property
    def sent(self) -> list[SceneNodeHandle]:
        """The nodes in the scene."""
        return [chunk.node for chunk in self.chunks.values() if chunk.node is not None]

    def show(self, cells: NDArray[np.int32], colours: NDArray[np.uint8], eyes: NDArray[np.floating]) -> None:
        """Show only these cells (N, 3) in colours (N, 3), to viewpoints at `eyes` (n, 3) in metres."""
        now = {key: Chunk(*parts) for key, parts in split(cells, colours)}
        for key, chunk in self.chunks.items():
            if key not in now:
                _remove(chunk)
            elif chunk.is_like(now[key]):
                now[key] = chunk
            else:
                now[key].node = chunk.node
        self.chunks = now
        self.look_from(eyes)

    def look_from(self, eyes: NDArray[np.floating]) -> None:
        """Send what viewpoints at `eyes` (n, 3) additionally need."""
        keys = list(self.chunks)
        numbers = np.array([len(self.chunks[key].cells) for key in keys])
        found = levels(np.array(keys), numbers, eyes, self._size, self._max_cells)
        for key, doublings in zip(keys, found.tolist(), strict=True):
            chunk = self.chunks[key]
            if chunk.sent != doublings:
                self._send(key, chunk, doublings)

    def _send(self, key: Key, chunk: Chunk, doublings: int) -> None:
        cells, colours = coarser(chunk.cells, chunk.colours, doublings)
        size = self._size * (1 << doublings)
        before, name = chunk.node, f"{self._name}/{'_'.join(map(str, key))}_{doublings}"
        chunk.node = self._draws(self._server, name, (cells + 0.5) * size, colours, size)
        chunk.sent = doublings
        if before is not None and before.name != name:
            before.remove()


def split(
    cells: NDArray[np.int32], colours: NDArray[np.uint8]
) -> Iterator[tuple[Key, tuple[NDArray[np.int32], NDArray[np.uint8]]]]:
    """Yield each chunk's index, with its cells (n, 3) and their colours (n, 3) in a fixed order."""
    if not len(cells):
        return
    (px, py, pz), (x, y, z) = ((cells + HALF) >> CHUNK_BITS).astype(np.int64).T, (cells & (SIDE - 1)).T
    order = np.argsort((((((px << 15 | py) << 15 | pz) << CHUNK_BITS | x) << CHUNK_BITS | y) << CHUNK_BITS) | z)
    cells, colours = cells[order], colours[order]
    places = cells >> CHUNK_BITS
    starts = np.flatnonzero((np.diff(places, axis=0) != 0).any(axis=1)) + 1
    for part, tint in zip(np.split(cells, starts), np.split(colours, starts), strict=True):
        x, y, z = (int(n) for n in part[0] >> CHUNK_BITS)
        yield (x, y, z), (part, tint)


def coarser(
    cells: NDArray[np.int32], colours: NDArray[np.uint8], doublings: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Return the cells of a chunk in cells of 2^doublings times the side, in the mean colour of their parts."""
    if not doublings:
        return cells, colours
    bits = CHUNK_BITS - doublings
    large = cells >> doublings
    x, y, z = (large & ((1 << bits) - 1)).T
    place = (x << 2 * bits) | (y << bits) | z
    number = np.bincount(place, minlength=1 << 3 * bits)
    found, first = np.unique(place, return_index=True)
    sums = (np.bincount(place, weights=channel, minlength=1 << 3 * bits)[found] for channel in colours.T)
    return large[first], np.stack([total / number[found] for total in sums], axis=1).astype(np.uint8)


def levels(
    places: NDArray[np.integer],
    numbers: NDArray[np.integer],
    eyes: NDArray[np.floating],
    size: float,
    max_cells: int = MAX_CELLS,
) -> NDArray[np.int64]:
    """Return the number of doublings (n,) of cells in chunks at `places` (n, 3) with `numbers` (n,) cells.

    eyes: (m, 3) in metres; each chunk is as fine as the nearest needs. Each doubling leaves about a quarter of a
    surface's cells; the finest levels within `max_cells` are chosen.
    """
    if not len(places):
        return np.zeros(0, np.int64)
    low, high = places * SIDE * size, (places + 1) * SIDE * size
    beyond = np.maximum(np.maximum(low - eyes[:, None], eyes[:, None] - high), 0)  # from each eye to each box
    nearest = np.linalg.norm(beyond, axis=2).min(axis=0)
    angle = ANGLE
    while True:
        doublings = np.log2(np.maximum(nearest * angle / size, 1)).astype(np.int64).clip(0, COARSEST)
        if (numbers / 4.0**doublings).sum() <= max_cells or (doublings == COARSEST)[nearest > 0].all():
            return doublings
        angle *= WIDER


def _remove(chunk: Chunk) -> None:
    if chunk.node is not None:
        chunk.node.remove()
        chunk.node = None
