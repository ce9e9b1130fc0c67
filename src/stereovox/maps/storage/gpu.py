# SPDX-License-Identifier: Apache-2.0
"""A map whose blocks are on a graphics card, and evidence there: they meet without leaving it.

Reading cells copies the whole map to the processor, where the copy stays valid until the next frame.
Imported only if `device = "cuda"`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.kernels._gpu import gpu_array, launch, to_gpu
from stereovox.kernels.device import check_device
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.cell_pool import GROWTH, CellPool
from stereovox.maps.cells.evidence import LARGEST, LOG_ODDS_SCALE, Evidence
from stereovox.maps.record.glance import Agreement, sampled
from stereovox.maps.storage import _gpu
from stereovox.maps.storage.blocks import CELLS, StoredCells, table_size
from stereovox.maps.storage.storage import Storage
from stereovox.maps.voxel_map import VoxelMap

ROOM = 4096
"""Initial capacity of a map in blocks: 4 MB of cells of 16 bits."""


class GpuArrays(NamedTuple):
    """Arrays of a frame's evidence on the card, with room for more blocks."""

    coords: Any  # (room, 3) int32
    values: Any  # (room, 512) int16
    said: Any  # (room,) int16, 0 if all of a block's values are
    uniform: Any  # (room, 3) int32
    steps: Any  # (room,) int16; 0: a block to ignore


class GpuEvidence(Evidence):
    """Evidence of one frame on the card; reading it copies it from there.

    arrays: the first `n` blocks and the first `m` uniform ones count.
    """

    def __init__(self, arrays: GpuArrays, n: int, m: int):
        vars(self).update(arrays=arrays, n=n, m=m)  # the base class is frozen

    arrays: GpuArrays
    n: int
    m: int

    @classmethod
    def of(cls, evidence: Evidence) -> GpuEvidence:
        """Return evidence on the card: the same object if it is already there."""
        if isinstance(evidence, GpuEvidence):
            return evidence
        said = evidence.values.any(axis=1).astype(np.int16)
        parts: Any = evidence.coords, evidence.values, said, evidence.uniform, evidence.uniform_values
        arrays = GpuArrays(*(to_gpu(_not_empty(part)) for part in parts))
        return cls(arrays, len(evidence.coords), len(evidence.uniform))

    @cached_property
    def coords(self) -> NDArray[np.int32]:
        """Block coordinates (n, 3)."""
        return from_gpu(self.arrays.coords, self.n)

    @cached_property
    def values(self) -> NDArray[np.int16]:
        """Evidence (n, 512)."""
        return from_gpu(self.arrays.values, self.n)

    @cached_property
    def uniform(self) -> NDArray[np.int32]:
        """Coordinates (m', 3) of the uniform blocks that count."""
        return from_gpu(self.arrays.uniform, self.m)[self._counts]

    @cached_property
    def uniform_values(self) -> NDArray[np.int16]:
        """Evidence for all cells of each (m',)."""
        return from_gpu(self.arrays.steps, self.m)[self._counts]

    @cached_property
    def _counts(self) -> NDArray[np.bool_]:
        return from_gpu(self.arrays.steps, self.m) != 0


def _not_empty(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array, or one zero row if it is empty: the card has no empty arrays."""
    return array if len(array) else np.zeros((1, *array.shape[1:]), array.dtype)


def from_gpu(array: Any, n: int) -> NDArray[Any]:
    """Return a copy of the first `n` rows of an array on the card."""
    return array[:n].copy_to_host() if n else np.empty((0, *array.shape[1:]), array.dtype)


class GpuPool:
    """All blocks of a map on the card, for reading as in `CellPool`; each has a row of numbers, even at the floor
    value.

    Unused rows hold `unknown`. rows: initial capacity.
    """

    def __init__(self, rules: CellRules, rows: int):
        self._rules = rules
        self._limits = tuple(map(np.int16, (rules.format.unknown, rules.prior, rules.lowest, rules.highest)))
        self._used = 0
        self._host: CellPool | None = CellPool(rules)
        self._counts = gpu_array(_gpu.COUNTS, np.int32, 0)
        self._places: tuple[Any, ...] = gpu_array(1, np.int32), gpu_array(1, np.int32)
        self._table, self._coords, self._values = self._arrays(rows)

    @classmethod
    def of(cls, host: CellPool) -> GpuPool:
        """Return a pool with the blocks of another."""
        pool = cls(host.rules, 1)
        pool._fill(host)
        return pool

    def __reduce__(self) -> tuple[Any, tuple[CellPool]]:
        return GpuPool.of, (self.host,)

    def __len__(self) -> int:
        return self._used

    @property
    def host(self) -> CellPool:
        """The blocks in the processor's memory, copied on first use after a change."""
        if self._host is None:
            self._host = CellPool(self._rules)
            self._host.put(from_gpu(self._coords, self._used), from_gpu(self._values, self._used))
        return self._host

    @property
    def on_gpu(self) -> StoredCells:
        """The pool for read-only kernels on the card; valid until the pool changes."""
        unknown = np.int32(self._rules.format.unknown)
        return StoredCells(self._table, self._coords, self._values, unknown, self._rules.lowest)

    @property
    def stored_cells(self) -> StoredCells:
        """The pool for the processor's read-only kernels; valid until the pool changes."""
        return self.host.stored_cells

    @property
    def memory_bytes(self) -> int:
        """Bytes in use on the card: rows, coordinates and the hash."""
        row = CELLS * self._values.dtype.itemsize + 3 * self._coords.dtype.itemsize
        return self._used * row + self._table.nbytes

    @property
    def reserved_bytes(self) -> int:
        """Bytes of all arrays on the card, in use or not."""
        return self._values.nbytes + self._coords.nbytes + self._table.nbytes

    def put(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole blocks: coordinates (n, 3), cells (n, 512) as stored; earlier content is lost."""
        host = self.host
        host.put(coords, cells)
        self._fill(host)

    def within(
        self, low: NDArray[np.integer], high: NDArray[np.integer]
    ) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return the blocks from `low` (3,) to below `high` (3,), and their cells (n, 512) as stored, in no order."""
        return self.host.within(low, high)

    def pieces(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
        """Yield coordinates (n, 3) and cells (n, 512) of all current blocks, in ascending order."""
        yield from self.host.pieces()

    def make_room(self, evidence: GpuEvidence) -> None:
        """Make room for the blocks of evidence.

        Raises FrameRefused `memory_full`, and changes nothing, if the card has none.
        """
        sizes = evidence.n, evidence.m
        try:
            self._places = tuple(
                places if len(places) >= size else gpu_array(int(GROWTH * size), np.int32)
                for places, size in zip(self._places, sizes, strict=True)
            )
            if self._used + sum(sizes) > len(self._coords):
                self._find(evidence)
                missing = int(self._counts.copy_to_host()[_gpu.MISSING])
                self._set_used(self._used)  # undo the count for this evidence
                self._reserve(missing)
        except MemoryError:
            raise FrameRefused(
                "memory_full",
                f"the graphics card has no room for the blocks of a frame next to the map's {self._used}; "
                'use larger cells, or device "cpu" with max_memory or a window',
            ) from None

    def add(self, evidence: GpuEvidence) -> int:
        """Add evidence in differences of stored numbers; return the number of cells that changed.

        Raises FrameRefused as `make_room` does.
        """
        self.make_room(evidence)
        self._find(evidence)
        self._host = None
        arrays, n, m = evidence.arrays, evidence.n, evidence.m
        blocks, uniform = self._places
        for places, wanted, size in ((blocks, arrays.coords, n), (uniform, arrays.uniform, m)):
            launch(_gpu.make_rows, self._table, self._coords, self._counts, wanted, size, places)
        launch(_gpu.add, self._values, blocks, arrays.values, n, self._limits, self._counts)
        launch(_gpu.add_uniform, self._values, uniform, arrays.steps, m, self._limits, self._counts)
        counts = self._counts.copy_to_host()
        self._set_used(int(counts[_gpu.USED]))
        return int(counts[_gpu.CHANGED])

    def _find(self, evidence: GpuEvidence) -> None:
        """Write the places of the evidence's blocks to `_places`, and count the missing ones."""
        (coords, _, said, uniform, steps), n, m = evidence.arrays, evidence.n, evidence.m
        for places, wanted, given, size in zip(self._places, (coords, uniform), (said, steps), (n, m), strict=True):
            launch(_gpu.find_places, self._table, self._coords, wanted, given, size, places, self._counts)

    def _set_used(self, used: int) -> None:
        self._used = used
        self._counts.copy_to_device(np.array([used, 0, 0], np.int32))

    def _arrays(self, rows: int) -> tuple[Any, Any, Any]:
        table = gpu_array(table_size(rows), np.int32, -1)
        values = gpu_array((rows, CELLS), self._rules.format.dtype, self._rules.format.unknown)
        return table, gpu_array((rows, 3), np.int32), values

    def _reserve(self, more: int) -> None:
        """Make room for this many more rows; all keep their place. Raises MemoryError, and changes nothing."""
        if self._used + more <= len(self._coords):
            return
        table, coords, values = self._arrays(int(GROWTH * (self._used + more)))
        for old, new in ((self._coords, coords), (self._values, values)):
            launch(_gpu.copy, old.reshape(old.size), new.reshape(new.size), self._used * (old.size // len(old)))
        launch(_gpu.enter_all, table, coords, self._used)
        self._table, self._coords, self._values = table, coords, values

    def _fill(self, host: CellPool) -> None:
        """Replace all blocks with the blocks of `host`."""
        coords, cells = host.get(host.block_coords)
        self._table, self._coords, self._values = self._arrays(max(ROOM, int(GROWTH * len(coords))))
        if len(coords):
            self._coords[: len(coords)].copy_to_device(np.ascontiguousarray(coords))
            self._values[: len(coords)].copy_to_device(np.ascontiguousarray(cells))
        launch(_gpu.enter_all, self._table, self._coords, len(coords))
        self._set_used(len(coords))
        self._host = host


class GpuStorage(Storage):
    """The blocks of a map without bounds, on a graphics card. Raises MemoryError if not even an empty one fits."""

    _pool: GpuPool  # pyrefly: ignore[bad-override] - set once

    def __init__(self, config: Config):
        super().__init__(config)
        self._pool = GpuPool(self.rules, ROOM)

    def check_room(self, evidence: Evidence) -> None:
        """Make room on the card for all blocks of `evidence`; raises FrameRefused `memory_full`."""
        self._pool.make_room(GpuEvidence.of(evidence))

    def agreement(self, evidence: Evidence, firm: int) -> Agreement:
        """Return how far `evidence` agrees with certain cells of the map; see `Storage.agreement`."""
        mine, stored, sure = GpuEvidence.of(evidence), self._pool.on_gpu, self.rules.sure

        def weigh(least: np.int16, mask: np.uint32) -> NDArray[np.float64]:
            sums, (coords, values, _, uniform, steps) = gpu_array(5, np.int64, 0), mine.arrays
            launch(_gpu.weigh, stored, sure, least, coords, values, mine.n, mask, sums)
            launch(_gpu.weigh_uniform, stored, sure, uniform, steps, mine.m, mask, sums)
            return sums.copy_to_host().astype(np.float64)

        return sampled(mine.n + mine.m, firm, weigh)

    def add(self, evidence: Evidence) -> int:
        """Add the evidence of one frame, wherever it is; return the number of cells whose value changed."""
        mine = self._in_my_units(evidence)
        if not (mine.n or mine.m):
            return 0
        changed = self._pool.add(mine)
        for listener in self.listeners:
            listener(mine)
        return changed

    def _in_my_units(self, evidence: Evidence) -> GpuEvidence:
        evidence = GpuEvidence.of(evidence)
        factor, most = self.cell_format.per_log_odds / LOG_ODDS_SCALE, self._most_rise
        if factor == 1 and most is None:
            return evidence
        shift, arrays = self.cell_format.shift(self.history.frames), evidence.arrays
        values, steps = gpu_array(arrays.values.shape, np.int16), gpu_array(arrays.steps.shape, np.int16)
        shift32 = np.float32(factor), np.float32(shift), np.float32(most or LARGEST)
        launch(_gpu.rescale, arrays.values, evidence.n, *shift32, values)
        launch(_gpu.rescale_steps, arrays.steps, evidence.m, np.float64(factor), np.float64(shift), steps)
        return GpuEvidence(arrays._replace(values=values, steps=steps), evidence.n, evidence.m)


def gpu_map(config: Config, resume: VoxelMap | None) -> VoxelMap:
    """Return a map on the card, with the cells and the history of `resume`; `resume` itself if it is already there.

    Raises ConfigError without a card.
    """
    check_device()
    if resume is not None and type(resume.storage) is GpuStorage:
        resume.storage.continue_with(config)
        return resume
    made = VoxelMap(config, storage=GpuStorage(config))
    if resume is not None:
        with resume.lock:
            made.storage.fill(resume.storage, [resume.storage.blocks()])
    return made
