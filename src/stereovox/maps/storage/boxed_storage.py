# SPDX-License-Identifier: Apache-2.0
"""Storage of a map in boxes that is used without loading it: recently used boxes are cached, up to a size."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from math import prod
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.files.places import AT_ONCE, Place
from stereovox.frame import Viewpoint
from stereovox.maps.cells.cell_pool import LAST, NEVER, PIECE, UNIT_NS, CellPool, CellTimes
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.files.boxed_manifest import BoxedManifest
from stereovox.maps.query import queries
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.storage.blocks import CELLS, SIDE, StoredCells
from stereovox.maps.storage.boxes import BoxBlocks, BoxEntry, Index, read_box
from stereovox.maps.storage.storage import Blocks, Storage
from stereovox.maps.storage.window import format_bytes

CACHE_BYTES = 256_000_000
"""Memory for recently used boxes."""
PER_BLOCK = 32
"""Approximate bytes of a block's coordinates and hash slots."""
NEAR = 0.01
"""A point this near to a cell's face, in cells, may count as in the next cell."""

Wanted = Callable[[BoxEntry], bool]
"""Returns whether a box must be read to answer a query."""


def any_box(entry: BoxEntry) -> bool:
    """Return that a box must be read, whatever its content."""
    return True


class BoxedStorage(Storage):
    """The blocks of a map in boxes; they are read on demand, and never changed.

    Queries at points use `parts`, which reads the boxes around them. `stored_cells`, which needs all cells at once,
    works only if they fit into the cache, and otherwise raises an error that names the cure; `slabs` reads the map box
    by box.

    place, manifest: location and content of the map. cache_bytes: memory limit of the cached boxes.
    """

    bounded = True

    def __init__(self, place: Place, manifest: BoxedManifest, cache_bytes: int = CACHE_BYTES):
        super().__init__(manifest.layout.config)
        self.place, self.manifest, self.cache_bytes = place, manifest, cache_bytes
        self.history, self.viewpoint = manifest.history, manifest.viewpoint
        self._entries = {entry.box: entry for entry in manifest.boxes}
        self._boxes = np.array(list(self._entries), np.int64).reshape(-1, 3)
        self._loaded: OrderedDict[Index, NDArray[np.int32]] = OrderedDict()
        self._used = 0
        rows, blocks = sum(entry.rows for entry in manifest.boxes), sum(entry.blocks for entry in manifest.boxes)
        self._pool = CellPool(
            self.rules,
            min(rows, cache_bytes // self._row_bytes) + 1,
            min(blocks - rows, cache_bytes // PER_BLOCK) + 1,
        )
        if self._times is not None:
            self._times = CellTimes(self.config.map, min(blocks, cache_bytes // (4 * CELLS)) + 1)
            self._times.start_ns = manifest.times_start_ns

    def parts(
        self, low: NDArray[np.integer], high: NDArray[np.integer], wanted: Wanted = any_box
    ) -> Iterator[NDArray[np.int64]]:
        """Yield indices (m,) of items in groups; meanwhile the boxes they need are in `cells_here`.

        low, high: cells (N, 3) from the lowest to the highest that each item needs, both included. wanted: boxes for
        which it is false may be skipped; their cells are then unknown. Raises StereovoxError for an item that needs
        more than the cache holds, and MapFileError for a damaged box.
        """
        if not len(low):
            return
        ranges, of_item, number = np.unique(self._ranges(low, high), axis=0, return_inverse=True, return_counts=True)
        items = np.split(np.argsort(of_item.ravel(), kind="stable"), np.cumsum(number)[:-1])
        waiting: list[NDArray[np.int64]] = []
        boxes: set[Index] = set()
        cost = 0
        for (first, last), mine in zip(ranges.reshape(-1, 2, 3), items, strict=True):
            theirs = {box for box in self._within(first, last) if wanted(self._entries[box])}
            if waiting and cost + self._cost(theirs - boxes) > self.cache_bytes:
                self._load(boxes)
                yield np.concatenate(waiting)
                waiting, boxes, cost = [], set(), 0
            waiting.append(mine)
            cost += self._cost(theirs - boxes)
            boxes |= theirs
        self._load(boxes)
        yield np.concatenate(waiting)

    @property
    def bytes_of_all(self) -> int:
        """Bytes of all boxes in memory."""
        return self._cost(self._entries)

    @property
    def cells_here(self) -> StoredCells:
        """The cells of the cached boxes, for kernels; all others are unknown."""
        return self._pool.stored_cells

    @property
    def stored_cells(self) -> StoredCells:
        """All cells, for read-only kernels. Raises StereovoxError if they do not fit into the cache."""
        self._load(self._entries)
        return self._pool.stored_cells

    def cells_within(self, low: ArrayLike, high: ArrayLike) -> StoredCells:
        """Return cells that include those from `low` (3,) to below `high` (3,), for read-only kernels."""
        for _ in self.parts(np.reshape(low, (1, 3)), np.reshape(high, (1, 3)) - 1):
            pass
        return self._pool.stored_cells

    def cells_of(self, coords: NDArray[np.int32]) -> NDArray[np.integer]:
        """Return the cells (n, 512) as stored of blocks (n, 3), all unknown if there is none."""
        cells = np.full((len(coords), CELLS), self.cell_format.unknown, self.cell_format.dtype)
        for part in self._parts_of_blocks(coords):
            cells[part] = self._cells_in(self._pool.stored_cells, coords[part])
        return cells

    def stored_at(self, points: NDArray[np.floating]) -> NDArray[np.integer]:
        """Return the stored numbers (N,) of the cells at points (N, 3)."""
        stored = np.full(len(points), self.cell_format.unknown, self.cell_format.dtype)
        asked = np.flatnonzero((np.abs(points) < INDEX_LIMIT * np.array(self.config.cell)).all(axis=1))  # False for NaN
        cells = points[asked] / np.array(self.config.cell)
        low, high = (np.floor(cells + off).astype(np.int64) for off in (-NEAR, NEAR))
        for part in self.parts(low, high):
            stored[asked[part]] = queries.stored_at(self.cells_here, self.config.cell, points[asked[part]])
        return stored

    def times_of(self, coords: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Return the times (n, 512) of the cells of blocks (n, 3), NEVER if there is none."""
        times = np.zeros((len(coords), CELLS), np.uint32)
        for part in self._parts_of_blocks(coords):
            times[part] = self._kept_times.get(coords[part])
        return times

    def slabs_within(self, low: ArrayLike, high: ArrayLike) -> Iterator[Blocks]:
        """Yield the blocks with coordinates (3,) from `low` to below `high`, box by box."""
        low, high = np.asarray(low), np.asarray(high)
        side = self.manifest.layout.side // SIDE
        for box in sorted(self._within(low // side, (high - 1) // side)):
            coords, cells, *_ = self._read(box)
            inside = ((coords >= low) & (coords < high)).all(axis=1)
            yield coords[inside], cells[inside]

    def blocks_within(self, low: ArrayLike, high: ArrayLike) -> Blocks:
        """Return the blocks with coordinates (3,) from `low` to below `high`; both are copies."""
        nothing = np.empty((0, 3), np.int32), np.empty((0, CELLS), self.cell_format.dtype)
        coords, cells = zip(nothing, *self.slabs_within(low, high), strict=True)
        return np.concatenate(coords), np.concatenate(cells)

    def blocks(self) -> Blocks:
        """Return block coordinates (n, 3) in ascending order and their cells (n, 512) as stored."""
        coords, cells = super().blocks()
        order = np.lexsort(coords.T[::-1])
        return coords[order], cells[order]

    def in_memory(self) -> Iterator[Blocks]:
        """Yield all blocks, as `slabs` does."""
        yield from self.slabs()

    def check_can_grow(self) -> None:
        """Raise StereovoxError: nothing can be added to a map in boxes."""
        self._refuse()

    def insert(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Raise StereovoxError: a map in boxes is read-only."""
        self._refuse()

    def set_viewpoint(self, viewpoint: Viewpoint) -> None:
        """Raise StereovoxError: a map in boxes is read-only."""
        self._refuse()

    def add(self, evidence: Evidence) -> int:
        """Raise StereovoxError: a map in boxes is read-only."""
        self._refuse()

    def continue_with(self, config: Config) -> None:
        """Raise StereovoxError: a map in boxes is read-only."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise StereovoxError(
            f"{self.place}: nothing can be added to a map in boxes; take a part of it and go on with that: "
            f"stereovox crop {self.place} part.svox --box=X0,Y0,Z0,X1,Y1,Z1"
        )

    @property
    def _row_bytes(self) -> int:
        return CELLS * self.cell_format.dtype.itemsize

    def _ranges(self, low: NDArray[np.integer], high: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the first and last box (N, 6) for cells from `low` (N, 3) to `high`, clipped to existing boxes."""
        if not len(self._boxes):
            return np.zeros((len(low), 6), np.int64)
        ends = self._boxes.min(axis=0) - 1, self._boxes.max(axis=0) + 1
        side = np.int64(self.manifest.layout.side)
        return np.concatenate([np.clip(np.asarray(cells, np.int64) // side, *ends) for cells in (low, high)], axis=1)

    def _within(self, first: NDArray[np.integer], last: NDArray[np.integer]) -> list[Index]:
        """Return the boxes of the map from `first` (3,) to `last` (3,), both included."""
        sides = [int(n) for n in np.maximum(last - first + 1, 0)]
        if prod(sides) > len(self._boxes):
            inside = ((self._boxes >= first) & (self._boxes <= last)).all(axis=1)
            return [(i, j, k) for i, j, k in self._boxes[inside].tolist()]
        spans = (range(int(a), int(b) + 1) for a, b in zip(first, last, strict=True))
        return [(i, j, k) for i, j, k in product(*spans) if (i, j, k) in self._entries]

    def _cost(self, boxes: Iterable[Index]) -> int:
        """Return the bytes of boxes in memory."""
        per_time = 0 if self._times is None else 4 * CELLS
        entries = (self._entries[box] for box in boxes)
        return sum(entry.rows * self._row_bytes + entry.blocks * (PER_BLOCK + per_time) for entry in entries)

    def _load(self, boxes: Iterable[Index]) -> None:
        """Load boxes into the cache; the least recently used make room."""
        boxes = list(boxes)
        if (needed := self._cost(boxes)) > self.cache_bytes:
            raise StereovoxError(
                f"{self.place}: this needs {format_bytes(needed)} of the map at once, the cache holds "
                f"{format_bytes(self.cache_bytes)}; ask for a smaller part (stereovox crop), or open the map with "
                "load_map(path, cache_bytes=...)"
            )
        missing = [box for box in boxes if box not in self._loaded]
        for box in boxes:
            if box in self._loaded:
                self._loaded.move_to_end(box)
        self._make_room(self.cache_bytes - self._cost(missing))
        with ThreadPoolExecutor(AT_ONCE) as pool:
            for start in range(0, len(missing), AT_ONCE):  # so that few wait for the cache
                some = missing[start : start + AT_ONCE]
                for box, blocks in zip(some, pool.map(self._read, some), strict=True):
                    self._put(box, blocks)

    def _make_room(self, most: int) -> None:
        """Evict boxes until the cache takes no more than `most` bytes."""
        while self._used > most:
            box, coords = self._loaded.popitem(last=False)
            self._used -= self._cost([box])
            self._pool.remove(coords)
            if self._times is not None:
                self._times.remove(coords)

    def _put(self, box: Index, blocks: BoxBlocks) -> None:
        self._used += self._cost([box])
        self._loaded[box] = blocks.coords
        self._pool.put(blocks.coords, blocks.cells)
        if self._times is not None and blocks.times is not None:
            self._times.put(blocks.coords, blocks.times)

    def _read(self, box: Index) -> BoxBlocks:
        """Return the blocks of one box from its files, without caching them; thread-safe."""
        entry = self._entries[box]
        return self._as_mine(entry, read_box(self.place, self.manifest.layout, entry))

    def _as_mine(self, entry: BoxEntry, blocks: BoxBlocks) -> BoxBlocks:
        """Return the blocks of a box with values clamped to the cells' limits, and times rebased to this map's."""
        cells = np.clip(blocks.cells, self.rules.lowest, self.rules.highest).astype(self.cell_format.dtype, copy=False)
        times, begun_ns, start_ns = blocks.times, entry.times_start_ns, self.manifest.times_start_ns
        if times is not None and begun_ns is not None and start_ns is not None and begun_ns != start_ns:
            later = (begun_ns - start_ns) // UNIT_NS
            moved = np.clip(times.astype(np.int64) + later, NEVER + 1, LAST).astype(np.uint32)
            times = np.where(times == NEVER, times, moved)
        return BoxBlocks(blocks.coords, cells, times, start_ns)

    def _parts_of_blocks(self, coords: NDArray[np.int32]) -> Iterator[NDArray[np.int64]]:
        low = SIDE * np.asarray(coords, np.int64)
        return self.parts(low, low + SIDE - 1)

    def _slabs(self) -> Iterator[Blocks]:
        """Yield all blocks box by box, in ascending order within a box."""
        for coords, cells, _ in self._pieces():
            yield coords, cells

    def _timed(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32]]]:
        for coords, cells, times in self._pieces():
            yield coords, cells, np.zeros(cells.shape, np.uint32) if times is None else times

    def _pieces(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32] | None]]:
        for box in sorted(self._entries):
            coords, cells, times, _ = self._read(box)
            for start in range(0, len(coords), PIECE):
                part = slice(start, start + PIECE)
                yield coords[part], cells[part], None if times is None else times[part]
        if not self._entries:
            yield np.empty((0, 3), np.int32), np.empty((0, CELLS), self.cell_format.dtype), None
