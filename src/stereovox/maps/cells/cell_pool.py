# SPDX-License-Identifier: Apache-2.0
"""All blocks of a voxel map: those with a row of numbers, and bare ones, whose cells are all as free as possible.

Times of cells: when each got its last evidence, and which cells have expired.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil, inf

import numpy as np
from numpy.typing import NDArray

from stereovox.config import MapConfig
from stereovox.kernels.threads import in_shards, shards
from stereovox.maps.cells import _add, _pool
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, BlockPool, StoredCells, table_size

GROWTH = 1.5
"""A full pool grows by this factor; one that is SPARE times too large shrinks to this many times its use."""
SPARE = 4
PIECE = 1024
"""Most blocks that `pieces` yields at once."""
WORTH_A_THREAD = 2048
"""Blocks of evidence whose work takes as long as waking a thread."""


class CellPool:
    """Blocks of 8x8x8 cells by their coordinates; cell (i, j, k) of a block is number `64 i + 8 j + k` of 512.

    A block without known cells is not kept. If all its cells have the lowest number, like most empty space of a room,
    it is bare: it has coordinates, but no row of numbers.

    values: (rows, 512) stored numbers, of which the first `count[0]` are in use.
    coords: (rows + bare, 3) int32 block coordinates: rows first, and from `len(values)` on the bare ones.
    count: (2,) int64, rows and bare blocks in use.
    table: the hash from block coordinates to places in `coords`.
    rows, bare: initial capacity; the pool never shrinks below it.
    """

    def __init__(self, rules: CellRules, rows: int = 256, bare: int = 256):
        self.rules = rules
        self._limits = tuple(map(np.int16, (rules.format.unknown, rules.prior, rules.lowest, rules.highest)))
        self._least = rows, bare
        self._has_settled = False
        self.count = np.zeros(2, np.int64)
        self.values = np.empty((0, CELLS), rules.format.dtype)
        self.coords = np.empty((0, 3), np.int32)
        self._resize(rows, bare)

    def __len__(self) -> int:
        return int(self.count.sum())

    @property
    def unknown(self) -> int:
        """Value of a cell without evidence."""
        return self.rules.format.unknown

    @property
    def memory_bytes(self) -> int:
        """Bytes in use: rows, coordinates and the hash."""
        return (
            int(self.count[0]) * self.values.itemsize * CELLS + len(self) * self.coords[:1].nbytes + self.table.nbytes
        )

    @property
    def reserved_bytes(self) -> int:
        """Bytes of all arrays, in use or not; the system need not have provided memory never used."""
        return self.values.nbytes + self.coords.nbytes + self.table.nbytes

    @property
    def stored_cells(self) -> StoredCells:
        """The pool for read-only kernels; valid until the pool changes."""
        unknown = np.int32(self.rules.format.unknown)
        return StoredCells(self.table, self.coords, self.values, unknown, self.rules.lowest)

    @property
    def arrays(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.integer], NDArray[np.int64]]:
        """The pool for kernels that change it; room must be reserved first."""
        return self.table, self.coords, self.values, self.count

    @property
    def block_coords(self) -> NDArray[np.int32]:
        """Coordinates (n, 3) of all blocks, in no order."""
        return self.coords[self._places()]

    def put(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole blocks: coordinates (n, 3), cells (n, 512) as stored; earlier content is lost."""
        kinds, places = np.empty(len(coords), np.uint8), np.empty(len(coords), np.int64)
        coords, cells = np.ascontiguousarray(coords, np.int32), np.ascontiguousarray(cells)
        _pool.needs(cells, self._limits[0], self._limits[2], kinds)
        _pool.find_all(self.table, self.coords, coords, places)  # an existing block keeps its room
        new_row, new_bare = (places < 0) | (places >= len(self.values)), places < len(self.values)
        self._reserve(int(((kinds == _pool.ROW) & new_row).sum()), int(((kinds == _pool.BARE) & new_bare).sum()))
        _pool.put(*self.arrays, coords, cells, kinds)
        self._shrink()

    def get(self, coords: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return the existing ones of the blocks (n, 3), and their cells (n, 512) as stored."""
        places = np.empty(len(coords), np.int64)
        _pool.find_all(self.table, self.coords, coords, places)
        return coords[places >= 0], self._cells_at(places[places >= 0], self.values)

    def within(
        self, low: NDArray[np.integer], high: NDArray[np.integer]
    ) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return the blocks from `low` (3,) to below `high` (3,), and their cells (n, 512) as stored, in no order."""
        places = self._places()
        coords = self.coords[places]
        inside = ((coords >= low) & (coords < high)).all(axis=1)
        return coords[inside], self._cells_at(places[inside], self.values)

    def remove(self, coords: NDArray[np.int32]) -> None:
        """Remove blocks (n, 3), whether present or not."""
        _pool.remove(*self.arrays, coords)
        self._shrink()

    def pieces(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
        """Yield coordinates (n, 3) and cells (n, 512) of all blocks in ascending order, at least once.

        Blocks created meanwhile are not yielded; others are as they are when yielded.
        """
        coords = self.block_coords
        coords = coords[np.lexsort(coords.T[::-1])]
        for start in range(0, max(len(coords), 1), PIECE):
            yield self.get(coords[start : start + PIECE])

    def add(
        self,
        coords: NDArray[np.int32],
        values: NDArray[np.int16],
        uniform: NDArray[np.int32],
        steps: NDArray[np.int16],
        threads: int,
    ) -> int:
        """Add `values` (n, 512) to blocks `coords` (n, 3), and `steps` (m,) to the cells of `uniform` (m, 3).

        Evidence is in differences of stored numbers; no block is named twice. Returns the number of cells that changed.
        """
        rows = self._rows_for(coords, values, uniform)
        floored, changed = np.zeros(len(rows), np.uint8), []

        def one_shard(part: slice) -> None:
            evidence = self.values, rows, part.start, part.stop, values, steps, np.empty(CELLS, np.int16)
            changed.append(_add.add(*evidence, *self._limits, floored))

        in_shards(one_shard, shards(len(rows), min(threads, len(rows) // WORTH_A_THREAD or 1)))
        sunk = int(np.count_nonzero(floored))
        if sunk or not self._has_settled:  # the first time always, so that its kernel is compiled with the others
            self._settle(sunk, coords, uniform, floored)
            self._has_settled = True
        return sum(changed)

    def needed_for(
        self, coords: NDArray[np.int32], values: NDArray[np.int16], uniform: NDArray[np.int32]
    ) -> tuple[int, int]:
        """Return the most rows and bare blocks in use while this evidence is added; changes nothing."""
        rows = np.empty(len(coords) + len(uniform), np.int32)
        made = _add.places(self.table, self.coords, self.values, coords, values, uniform, rows)
        has, bare = self.count.tolist()
        return has + made, bare + int(np.count_nonzero(rows != _add.SKIP))

    def needed_by(self, cells: NDArray[np.integer]) -> tuple[int, int]:
        """Return the rows and bare blocks in use after blocks of `cells` (n, 512) are added."""
        kinds = np.empty(len(cells), np.uint8)
        _pool.needs(np.ascontiguousarray(cells), self._limits[0], self._limits[2], kinds)
        has, bare = self.count.tolist()
        return has + int((kinds == _pool.ROW).sum()), bare + int((kinds == _pool.BARE).sum())

    def _rows_for(
        self, coords: NDArray[np.int32], values: NDArray[np.int16], uniform: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Return the rows (n + m,) that evidence goes to, created if missing; below 0 if it says nothing."""
        n, (unknown, _, lowest, _) = len(coords), self._limits
        rows = np.empty(n + len(uniform), np.int32)
        made = _add.places(self.table, self.coords, self.values, coords, values, uniform, rows)
        if made:
            self._reserve(made, 0)
            for blocks, theirs in ((coords, rows[:n]), (uniform, rows[n:])):
                _add.make_rows(*self.arrays, blocks, unknown, lowest, theirs)
        return rows

    def _settle(
        self, sunk: int, coords: NDArray[np.int32], uniform: NDArray[np.int32], floored: NDArray[np.uint8]
    ) -> None:
        """Remove the rows of the `sunk` blocks at the floor value, marked in `floored` (n + m,)."""
        n, (unknown, _, lowest, _) = len(coords), self._limits
        self._reserve(0, sunk)
        for blocks, theirs in ((coords, floored[:n]), (uniform, floored[n:])):
            _add.settle(*self.arrays, blocks, theirs, unknown, lowest)
        self._shrink()

    def _places(self) -> NDArray[np.int64]:
        rows, bare = self.count.tolist()
        return np.concatenate([np.arange(rows), len(self.values) + np.arange(bare)])

    def _cells_at(self, places: NDArray[np.int64], values: NDArray[np.integer]) -> NDArray[np.integer]:
        cells = np.full((len(places), CELLS), self.rules.lowest, values.dtype)
        has_row = places < len(values)
        cells[has_row] = values[places[has_row]]
        return cells

    def _room(self) -> tuple[int, int]:
        return len(self.values), len(self.coords) - len(self.values)

    def _reserve(self, rows: int, bare: int) -> None:
        """Make room for this many more; rows keep their place."""
        used, room = self.count.tolist(), self._room()
        needed = used[0] + rows, used[1] + bare
        if needed[0] > room[0] or needed[1] > room[1]:
            self._resize(*(max(n, int(GROWTH * has)) if n > has else has for n, has in zip(needed, room, strict=True)))

    def _shrink(self) -> None:
        """Release room that is far from being used."""
        used = self.count.tolist()
        if any(has > max(SPARE * n, least) for has, n, least in zip(self._room(), used, self._least, strict=True)):
            self._resize(*(max(int(GROWTH * n), least) for n, least in zip(used, self._least, strict=True)))

    def _resize(self, rows: int, bare: int) -> None:
        (used, bare_used), before = self.count.tolist(), len(self.values)
        values = self.values if rows == before else np.empty((rows, CELLS), self.values.dtype)
        coords = np.empty((rows + bare, 3), np.int32)
        if rows != before:
            values[:used] = self.values[:used]
        coords[:used], coords[rows : rows + bare_used] = self.coords[:used], self.coords[before : before + bare_used]
        self.values, self.coords = values, coords
        self.table = np.empty(table_size(rows + bare), np.int32)
        _pool.rebuild(*self.arrays)


UNIT_NS = 10_000_000
"""Times are kept in steps of 10 ms."""
FIRST, LAST = 1 << 30, (1 << 32) - 1
"""The stored time of the map's first frame, and the largest one. Times from 124 days before to 373 days after the first
frame can be stored; others are clamped to that range."""
NEVER = int(_pool.NEVER)
LATE = 8
"""A cell is forgotten at most `forget_s` / LATE after its time is over."""


class CellTimes:
    """Times of cells in their own pool, indexed by block coordinates like `CellPool`.

    A time is valid only if the cell is known. start_ns: stamp of the first frame, None before it.
    """

    def __init__(self, config: MapConfig, capacity: int = 256):
        self.start_ns: int | None = None
        self._forget_ns = None if config.forget_s is None else max(ceil(config.forget_s * 1e9), LATE * _pool.SLOTS)
        self._blocks = BlockPool(np.uint32, capacity)
        self._has_written = self._has_forgotten = False  # at first all kernels are called, so that none compiles later

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def memory_bytes(self) -> int:
        """Bytes in use."""
        return self._blocks.memory_bytes

    @property
    def reserved_bytes(self) -> int:
        """Bytes of all arrays, in use or not."""
        blocks = self._blocks
        return blocks.values.nbytes + blocks.coords.nbytes + blocks.table.nbytes

    @property
    def late_ns(self) -> float:
        """How much longer than `forget_s` a cell may remain; infinite if none is forgotten."""
        return inf if self._forget_ns is None else self._forget_ns / LATE

    def steps(self, stamp_ns: int) -> np.uint32:
        """Return the stored number for a time in nanoseconds."""
        start_ns = stamp_ns if self.start_ns is None else self.start_ns
        return np.uint32(min(max((stamp_ns - start_ns) // UNIT_NS + FIRST, NEVER + 1), LAST))

    def missing(self, evidence: Evidence) -> int:
        """Return how many blocks `write` would create."""
        blocks = self._blocks
        return _pool.missing(blocks.table, blocks.coords, evidence.coords, evidence.values, evidence.uniform)

    def write(self, evidence: Evidence, stamp_ns: int) -> None:
        """Record when cells got evidence; times count from the first frame."""
        if self.start_ns is None:
            self.start_ns = stamp_ns
        blocks, first, self._has_written = self._blocks, not self._has_written, True
        if first or len(blocks) + len(evidence.coords) + len(evidence.uniform) > len(blocks.coords):
            blocks.reserve(self.missing(evidence))
        _pool.write(*self._arrays, evidence.coords, evidence.values, evidence.uniform, self.steps(stamp_ns))

    def get(self, coords: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Return the times (n, 512) of blocks (n, 3), NEVER if there are none."""
        places = self._places(coords)
        found = np.zeros((len(coords), CELLS), np.uint32)
        found[places >= 0] = self._blocks.values[places[places >= 0]]
        return found

    def put(self, coords: NDArray[np.int32], times: NDArray[np.uint32]) -> None:
        """Set the times (n, 512) of blocks (n, 3); those without any are not kept."""
        timed = times.any(axis=1)
        self.remove(coords[~timed])
        blocks, coords = self._blocks, np.ascontiguousarray(coords[timed], np.int32)
        blocks.reserve(int((self._places(coords) < 0).sum()))
        places = np.empty(len(coords), np.int64)
        _pool.insert_all(blocks.table, blocks.coords, blocks.count, coords, places)
        blocks.values[places] = times[timed]

    def remove(self, coords: NDArray[np.int32]) -> None:
        """Remove the times of blocks (n, 3), whether present or not."""
        _pool.remove_times(*self._arrays, np.ascontiguousarray(coords, np.int32))

    def follow(self, cells: CellPool, low: NDArray[np.int32], high: NDArray[np.int32]) -> None:
        """Remove the times of blocks that touch cells [low, high) and are no longer in `cells`."""
        _pool.follow(*self._arrays, cells.table, cells.coords, low, high)

    def seconds_ago(self, times: NDArray[np.uint32], now_ns: int) -> NDArray[np.float32]:
        """Return the ages of times, in seconds; negative if later than now, NaN for NEVER."""
        since = (int(self.steps(now_ns)) - times.astype(np.int64)) * (UNIT_NS / 1e9)
        return np.where(times == NEVER, np.nan, since).astype(np.float32)

    def forget(self, cells: CellPool, before_ns: int, now_ns: int) -> None:
        """Make cells unknown that had no evidence for `forget_s`, in the blocks whose turn was since `before_ns`.

        Each block has one turn in every eighth of `forget_s` by the stamps' clock, regardless of the frames.
        """
        if self._forget_ns is None:
            return
        turn_ns = self._forget_ns // (LATE * _pool.SLOTS)
        before, now = before_ns // turn_ns, now_ns // turn_ns
        if now > before or not self._has_forgotten:
            self._has_forgotten = True
            self._forget_in_turns((before + 1) % _pool.SLOTS, max(0, min(now - before, _pool.SLOTS)), cells, now_ns)

    def expired(self, times: NDArray[np.integer], now_ns: int) -> NDArray[np.bool_]:
        """Return which times expired: more than `forget_s` before now, or after it, as when a clock was reset."""
        if self._forget_ns is None:
            return np.zeros(times.shape, bool)
        away = np.abs(times.astype(np.int64) - int(self.steps(now_ns)))
        return (times != NEVER) & (away > int(self._most))

    def _forget_in_turns(self, first: int, turns: int, cells: CellPool, now_ns: int) -> None:
        blocks = self._blocks
        places = np.empty(len(blocks), np.int64)
        number = _pool.due(
            blocks.coords, blocks.values, blocks.count, first, turns, self.steps(now_ns), self._most, places
        )
        coords = blocks.coords[places[:number]]
        for start in range(0, max(number, 1), PIECE):
            some, left = cells.get(coords[start : start + PIECE])
            times = self.get(some)
            left[self.expired(times, now_ns)] = cells.unknown
            cells.put(some, left)
            self.put(some, np.where(left == cells.unknown, NEVER, times))

    @property
    def _most(self) -> np.uint32:
        assert self._forget_ns is not None
        return np.uint32(min(-(-self._forget_ns // UNIT_NS), LAST))

    @property
    def _arrays(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.uint32], NDArray[np.int64]]:
        return self._blocks.table, self._blocks.coords, self._blocks.values, self._blocks.count

    def _places(self, coords: NDArray[np.int32]) -> NDArray[np.int64]:
        places = np.empty(len(coords), np.int64)
        _pool.find_all(self._blocks.table, self._blocks.coords, np.ascontiguousarray(coords, np.int32), places)
        return places
