# SPDX-License-Identifier: Apache-2.0
"""Storage of a voxel map: its blocks, the times of their cells, its settings and history.

`VoxelMap` answers queries from it; code that reads or writes whole blocks uses `voxel_map.storage`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import ConfigError, StereovoxError
from stereovox.frame import Viewpoint
from stereovox.kernels.threads import Guarded, MapLock, in_steps
from stereovox.maps.cells import _add, _pool
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.cell_pool import NEVER, CellPool, CellTimes
from stereovox.maps.cells.evidence import LARGEST, LOG_ODDS_SCALE, Evidence
from stereovox.maps.query import queries
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.record.glance import Agreement, agreement
from stereovox.maps.record.history import History, WithHistory
from stereovox.maps.record.kept_frames import KeptFrames
from stereovox.maps.storage.blocks import CELLS, SIDE, StoredCells, blocks_of_cells
from stereovox.maps.storage.tiles import TileStore

EVERYWHERE = np.array([[-(2**30)] * 3, [2**30] * 3])
"""Lowest block allowed in `Storage.blocks_within`, and the first beyond the highest."""

NOT_OF_FRAMES = {"profile", "map", "threads", "trust", "deadline_ms", "amcl", "slam", "loops", "up_direction"}
"""Settings that do not change the evidence of past frames; `map` is compared separately."""

Blocks = tuple[NDArray[np.int32], NDArray[np.integer]]
"""Block coordinates (n, 3), and their cells (n, 512) as stored."""


def settings_of_frames(config: Config) -> list[str]:
    """Return the names of the settings, except `map`, that determine the evidence of past frames."""
    return [name for name in type(config).model_fields if name not in NOT_OF_FRAMES]


class OnStorage(WithHistory):
    """Attributes of a map kept in its storage; like plain attributes they are read without the lock."""

    storage: Any

    @property
    def config(self) -> Config:
        """The settings the map was made with."""
        return self.storage.config

    @property
    def voxel_size(self) -> float:
        """Side of a cell in metres: `config.voxel_size`."""
        return self.storage.config.voxel_size

    @property
    def history(self) -> History:
        """The map's record of its frames."""
        return self.storage.history

    @history.setter
    def history(self, history: History) -> None:
        self.storage.history = history


class Storage(Guarded):
    """The blocks of a map without bounds, in memory.

    Attributes:
        lock: Held during each call, and each call of the map.
        config: The settings.
        history: The map's record of its frames.
        viewpoint: Last camera pose; None before the first frame.
        window_state: Where the window was, for a map that has or had one.
        listeners: Called with the evidence after every `add`, the lock held. No other block has changed, except those
            that a window or time removed. After a correction of poses they get `uniform` evidence of 0 on all rebuilt
            blocks.
        kept: The depth images of all frames; None if they are not kept.
        rules: Meaning of stored numbers.
        cell_format: How log-odds are stored.
    """

    bounded = False
    """Whether memory limits what cells the map can take."""

    def __init__(self, config: Config):
        self.lock = MapLock()
        self.config = config
        self.history = History()
        self.viewpoint: Viewpoint | None = None
        self.window_state: dict[str, Any] | None = None
        self.listeners: list[Callable[[Evidence], object]] = []
        self.kept: KeptFrames | None = None
        self.rules = CellRules(config.map)
        self.cell_format = self.rules.format
        self._most_rise = self.rules.most_rise
        self._pool = CellPool(self.rules)
        self._times = CellTimes(config.map) if config.map.keep_times else None

    def check_cells(self, config: Config) -> None:
        """Raise ConfigError if `config` gives cells another meaning: their size or the `map` section.

        If a map continues to keep its frames, also if past frames would be mapped differently.
        """
        for name in ("voxel_size", "steps"):
            self._check_same(name, getattr(self.config, name), getattr(config, name))
        of_frames = {"keep_frames": config.map.keep_frames, "frames_budget": config.map.frames_budget}
        self._check_same("map", self.config.map.model_copy(update=of_frames), config.map)
        if self.kept is not None and config.map.keep_frames:
            for name in settings_of_frames(config):
                self._check_same(name, getattr(self.config, name), getattr(config, name))

    @staticmethod
    def _check_same(name: str, old: Any, new: Any) -> None:
        if old != new:
            raise ConfigError(f"cannot continue: the map was made with {name} {old}, the new setting is {new}")

    def continue_with(self, config: Config) -> None:
        """Adopt the settings of a run that continues this map; raises ConfigError as `check_cells` does."""
        self.check_cells(config)
        self.config = config

    def check_can_grow(self) -> None:
        """Raise StereovoxError if nothing can be added to this map; here it can."""

    def take_history(self, earlier: Storage) -> None:
        """Take over the frame record of `earlier`."""
        self.history, self.viewpoint = earlier.history.copied(), earlier.viewpoint

    def fill(self, other: Storage, blocks: Iterable[Blocks]) -> None:
        """Put `blocks` of another map into this one, with their times, and take over its history."""
        for coords, cells in blocks:
            self.insert(coords, cells)
            if self._times is not None:
                self.set_times(coords, other.times_of(coords), other.times_start_ns)
        self.take_history(other)

    @property
    def tile_store(self) -> TileStore | None:
        """The store of cells outside a window, if they are kept: none here."""
        return None

    @property
    def coords_in_memory(self) -> NDArray[np.int32]:
        """Coordinates (n, 3) of the blocks that are in memory, in no order."""
        return self._pool.block_coords

    def replace_blocks(self, coords: NDArray[np.int32], other: Storage) -> None:
        """Take over blocks (n, 3) from a map of the same settings, with their times; unknown if it has none."""
        coords = np.ascontiguousarray(coords, np.int32)
        self._pool.remove(coords)
        if self._times is not None:
            self._times.remove(coords)
        found, cells = other._pool.get(coords)
        self.insert(found, cells)
        if self._times is not None:
            self._times.put(found, other.times_of(found))

    def replace_contents(self, other: Storage) -> None:
        """Take over all cells of a map of the same settings, which must no longer be used."""
        self._pool, self._times = other._pool, other._times
        self.viewpoint, self.window_state = other.viewpoint, other.window_state

    def insert(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole blocks: coordinates (n, 3), cells (n, 512) as stored; earlier content is lost.

        Raises StereovoxError for other shapes.
        """
        if coords.ndim != 2 or coords.shape[1] != 3 or cells.shape != (len(coords), CELLS):
            raise StereovoxError(f"blocks are {coords.shape} with cells {cells.shape}; give (n, 3) and (n, {CELLS})")
        cells = np.clip(cells, self.rules.lowest, self.rules.highest)
        self._pool.put(coords, cells.astype(self.cell_format.dtype, copy=False))
        if self._times is not None:
            self._times.remove(coords)

    def set_viewpoint(self, viewpoint: Viewpoint) -> None:
        """Set the camera's pose; a bounded map moves with it, and cells without evidence for too long are forgotten."""
        before, self.viewpoint = self.viewpoint, viewpoint
        if self._times is not None:
            self._times.forget(self._pool, (before or viewpoint).stamp_ns, viewpoint.stamp_ns)

    def check_room(self, evidence: Evidence) -> None:
        """Do nothing: memory is unbounded here. Bounded storage raises FrameRefused `memory_full`."""

    def agreement(self, evidence: Evidence, firm: int) -> Agreement:
        """Return how far `evidence` agrees with certain cells of the map.

        firm: evidence of a hit, in thousandths, below which it may be noise.
        """
        return agreement(self.stored_cells, self.rules, evidence, firm)

    def add(self, evidence: Evidence) -> int:
        """Add the evidence of one frame; return the number of cells whose value changed."""
        if not (len(evidence.coords) or len(evidence.uniform)):
            return 0
        mine = self._in_my_units(self._yielding(evidence) if evidence.weak else evidence)
        if self._times is not None:
            self._times.write(mine, self._now_ns)
        changed = self._pool.add(mine.coords, mine.values, mine.uniform, mine.uniform_values, self.config.threads)
        for listener in self.listeners:
            listener(mine)
        return changed

    @property
    def stored_cells(self) -> StoredCells:
        """The cells for read-only kernels; valid until the map changes."""
        return self._pool.stored_cells

    def cells_within(self, low: ArrayLike, high: ArrayLike) -> StoredCells:
        """Return cells that include indices (3,) from `low` to below `high`, as `stored_cells`: here all of them.

        Maps that are not wholly in memory read only these.
        """
        return self.stored_cells

    def cells_of(self, coords: NDArray[np.int32]) -> NDArray[np.integer]:
        """Return the cells (n, 512) as stored of blocks (n, 3) in memory; all unknown if there is none."""
        return self._cells_in(self.stored_cells, coords)

    def stored_at(self, points: NDArray[np.floating]) -> NDArray[np.integer]:
        """Return the stored numbers (N,) of the cells at points (N, 3) as `queries.points_of` returns them."""
        return queries.stored_at(self.stored_cells, self.config.cell, points)

    def blocks(self) -> Blocks:
        """Return block coordinates (n, 3) in ascending order and their cells (n, 512) as stored."""
        coords, values = zip(*self.slabs(), strict=True)
        return np.concatenate(coords), np.concatenate(values)

    def blocks_within(self, low: ArrayLike, high: ArrayLike) -> Blocks:
        """Return the blocks in memory with coordinates (3,) from `low` to below `high`, in no order.

        Coordinates (n, 3), cells (n, 512) as stored; both are copies.
        """
        return self._pool.within(np.asarray(low), np.asarray(high))

    def slabs_within(self, low: ArrayLike, high: ArrayLike) -> Iterator[Blocks]:
        """Yield the blocks with coordinates (3,) from `low` to below `high`, piece by piece as `slabs` does."""
        for coords, cells in self.slabs():
            inside = ((coords >= np.asarray(low)) & (coords < np.asarray(high))).all(axis=1)
            yield coords[inside], cells[inside]

    def slabs(self) -> Iterator[Blocks]:
        """Yield all blocks as in `blocks`, piece by piece in ascending order; a map in boxes box by box.

        If the map changes meanwhile, each piece is as of its reading; hold `lock` to read one state.
        """
        yield from in_steps(self.lock, self._slabs())

    def in_memory(self) -> Iterator[Blocks]:
        """Yield the blocks that are in memory, as `slabs` does: all, or those of the window."""
        yield from in_steps(self.lock, self._pool.pieces())

    def timed(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32]]]:
        """Yield all blocks as `slabs` does, with the times (n, 512) of their cells, 0 if there is none.

        Raises StereovoxError if the map keeps no times. See `CellTimes`.
        """
        yield from in_steps(self.lock, self._timed())

    def times_of(self, coords: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Return the times (n, 512) of the cells of blocks (n, 3); valid if the cell is known."""
        return self._kept_times.get(coords)

    def times_at(self, points: NDArray[np.floating]) -> NDArray[np.uint32]:
        """Return the times (N,) of the cells at points (N, 3), NEVER outside the index range."""
        times = np.zeros(len(points), np.uint32)
        within = (np.abs(points) < INDEX_LIMIT * np.array(self.config.cell)).all(axis=1)  # False for NaN
        cells = np.floor(points[within] / self.config.cell).astype(np.int64)
        blocks, of_cell = blocks_of_cells(cells)
        x, y, z = (cells & (SIDE - 1)).T
        times[within] = self.times_of(blocks.astype(np.int32))[of_cell, (x << 6) | (y << 3) | z]
        return times

    def seconds_ago(self, times: NDArray[np.uint32], now_ns: int | None) -> NDArray[np.float32]:
        """Return ages at `now_ns` (None: the last frame) in seconds; NaN for NEVER."""
        return self._kept_times.seconds_ago(times, self._now_ns if now_ns is None else now_ns)

    def set_times(self, coords: NDArray[np.int32], times: NDArray[np.uint32], start_ns: int | None) -> None:
        """Set the times (n, 512) of blocks (n, 3) that are in the map, counted from `start_ns`."""
        self._kept_times.put(coords, times)
        self._kept_times.start_ns = start_ns

    @property
    def times_start_ns(self) -> int | None:
        """Stamp in nanoseconds from which times of cells are counted; None before the first and if none are kept."""
        return None if self._times is None else self._times.start_ns

    @property
    def memory_bytes(self) -> int:
        """Bytes in use: stored numbers, times, block coordinates and hash."""
        return self._pool.memory_bytes + (0 if self._times is None else self._times.memory_bytes)

    @property
    def reserved_bytes(self) -> int:
        """Bytes allocated: in use, and room to grow (which the system provides on first use)."""
        return self._pool.reserved_bytes + (0 if self._times is None else self._times.reserved_bytes)

    def close(self) -> None:
        """Remove what is on disk (nothing, unless a window keeps tiles there)."""

    def _slabs(self) -> Iterator[Blocks]:
        """Yield what `slabs` does; the lock is held while an item is produced."""
        yield from self._pool.pieces()

    def _timed(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32]]]:
        for coords, cells in self._slabs():
            times = self.times_of(coords)
            times[cells == self.cell_format.unknown] = NEVER
            yield coords, cells, times

    @staticmethod
    def _cells_in(stored: StoredCells, coords: NDArray[np.int32]) -> NDArray[np.integer]:
        """Return the cells (n, 512) of blocks (n, 3) as kernels see them."""
        places = np.empty(len(coords), np.int64)
        _pool.find_all(stored.table, stored.coords, np.ascontiguousarray(coords, np.int32), places)
        cells = np.full((len(coords), CELLS), stored.unknown, stored.values.dtype)
        has_row = (places >= 0) & (places < len(stored.values))
        cells[has_row] = stored.values[places[has_row]]
        cells[places >= len(stored.values)] = stored.lowest
        return cells

    def _yielding(self, evidence: Evidence) -> Evidence:
        """Return what is left of weak evidence (`CellRules.yielding`); no whole blocks of evidence that repeats."""
        values = self.rules.yielding(evidence.values, self.cells_of(evidence.coords), evidence.again)
        if not evidence.again:
            return replace(evidence, values=values)
        some = values.any(axis=1)
        return Evidence(evidence.coords[some], values[some], evidence.uniform[:0], evidence.uniform_values[:0])

    def _in_my_units(self, evidence: Evidence) -> Evidence:
        """Return the evidence as differences of stored numbers; blocks that would get a uniform 0 are left out."""
        factor, most = self.cell_format.per_log_odds / LOG_ODDS_SCALE, self._most_rise
        if factor == 1 and most is None and evidence.uniform_values.all():
            return evidence
        shift = self.cell_format.shift(self.history.frames)
        values = np.empty_like(evidence.values)
        _add.rescale(evidence.values, np.float32(factor), np.float32(shift), np.float32(most or LARGEST), values)
        steps = np.floor(evidence.uniform_values * factor + shift).astype(np.int16)
        some = steps != 0
        return Evidence(evidence.coords, values, evidence.uniform[some], steps[some])

    @property
    def _now_ns(self) -> int:
        return 0 if self.viewpoint is None else self.viewpoint.stamp_ns

    @property
    def _kept_times(self) -> CellTimes:
        if self._times is None:
            raise StereovoxError("the map does not keep when cells were seen; make it with map.keep_times = true")
        return self._times
