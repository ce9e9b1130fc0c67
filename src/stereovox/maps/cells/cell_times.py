# SPDX-License-Identifier: Apache-2.0
"""Times of cells: when each got its last evidence, and which cells have expired."""

from __future__ import annotations

from math import ceil, inf

import numpy as np
from numpy.typing import NDArray

from stereovox.config import MapConfig
from stereovox.maps.cells import _pool, _times
from stereovox.maps.cells.cell_pool import PIECE, CellPool
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, BlockPool

UNIT_NS = 10_000_000
"""Times are kept in steps of 10 ms."""
FIRST, LAST = 1 << 30, (1 << 32) - 1
"""The stored time of the map's first frame, and the largest one. Times from 124 days before to 373 days after the first
frame can be stored; others are clamped to that range."""
NEVER = int(_times.NEVER)
LATE = 8
"""A cell is forgotten at most `forget_s` / LATE after its time is over."""


class CellTimes:
    """Times of cells in their own pool, indexed by block coordinates like `CellPool`.

    A time is valid only if the cell is known. start_ns: stamp of the first frame, None before it.
    """

    def __init__(self, config: MapConfig, capacity: int = 256):
        self.start_ns: int | None = None
        self._forget_ns = None if config.forget_s is None else max(ceil(config.forget_s * 1e9), LATE * _times.SLOTS)
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
        return _times.missing(blocks.table, blocks.coords, evidence.coords, evidence.values, evidence.uniform)

    def write(self, evidence: Evidence, stamp_ns: int) -> None:
        """Record when cells got evidence; times count from the first frame."""
        if self.start_ns is None:
            self.start_ns = stamp_ns
        blocks, first, self._has_written = self._blocks, not self._has_written, True
        if first or len(blocks) + len(evidence.coords) + len(evidence.uniform) > len(blocks.coords):
            blocks.reserve(self.missing(evidence))
        _times.write(*self._arrays, evidence.coords, evidence.values, evidence.uniform, self.steps(stamp_ns))

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
        _times.remove(*self._arrays, np.ascontiguousarray(coords, np.int32))

    def follow(self, cells: CellPool, low: NDArray[np.int32], high: NDArray[np.int32]) -> None:
        """Remove the times of blocks that touch cells [low, high) and are no longer in `cells`."""
        _times.follow(*self._arrays, cells.table, cells.coords, low, high)

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
        turn_ns = self._forget_ns // (LATE * _times.SLOTS)
        before, now = before_ns // turn_ns, now_ns // turn_ns
        if now > before or not self._has_forgotten:
            self._has_forgotten = True
            self._forget_in_turns((before + 1) % _times.SLOTS, max(0, min(now - before, _times.SLOTS)), cells, now_ns)

    def expired(self, times: NDArray[np.integer], now_ns: int) -> NDArray[np.bool_]:
        """Return which times expired: more than `forget_s` before now, or after it, as when a clock was reset."""
        if self._forget_ns is None:
            return np.zeros(times.shape, bool)
        away = np.abs(times.astype(np.int64) - int(self.steps(now_ns)))
        return (times != NEVER) & (away > int(self._most))

    def _forget_in_turns(self, first: int, turns: int, cells: CellPool, now_ns: int) -> None:
        blocks = self._blocks
        places = np.empty(len(blocks), np.int64)
        number = _times.due(
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
