# SPDX-License-Identifier: Apache-2.0
"""The voxel map: unbounded, sparse, fixed-point log-odds in 16 or 8 bits a cell."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import ConfigError, StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import _add, queries
from stereovox.maps.blocks import CELLS, SIDE, StoredCells, blocks_of_cells
from stereovox.maps.cell_format import CellFormat, CellRules
from stereovox.maps.cell_format import State as State
from stereovox.maps.cell_pool import CellPool
from stereovox.maps.cell_times import NEVER, CellTimes
from stereovox.maps.evidence import LARGEST, LOG_ODDS_SCALE, Evidence
from stereovox.maps.frame_agreement import Agreement, agreement
from stereovox.maps.queries import INDEX_LIMIT as INDEX_LIMIT
from stereovox.maps.queries import Asked, NearestCells, RayHits
from stereovox.maps.store import read_map, save_map
from stereovox.threads import Guarded, MapLock, in_steps
from stereovox.trust.history import History, WithHistory

EVERYWHERE = np.array([[-(2**30)] * 3, [2**30] * 3])
"""Lowest block that `VoxelMap.blocks_within` may be asked for, and the first beyond the highest."""


class VoxelMap(Guarded, WithHistory):
    """A sparse occupancy map in the world frame (z up unless the recording says otherwise).

    Cell i covers [i, i + 1) * voxel_size on each axis, or of `config.cell` where its sides differ. A cell without
    evidence is unknown: log-odds 0, probability 0.5. With evidence it is free (p < free_below), occupied
    (p > occupied_above) or tentative between them.
    `config` holds the settings the map was made with, `history` what it remembers of its frames, `viewpoint` where the
    camera stood last, `window_state` where its window was, if it had one. `listeners` are called after every `add`
    with the evidence: no other block has changed, but for those that a window or time took away.
    Several threads may use a map: each call holds its `lock`. Listeners are called with it held.
    """

    def __init__(self, config: Config):
        self.lock = MapLock()
        self.config = config
        self.voxel_size = config.voxel_size
        self.history = History()
        self.viewpoint: Viewpoint | None = None
        self.window_state: dict[str, Any] | None = None
        self.listeners: list[Callable[[Evidence], None]] = []
        self._rules = CellRules(config.map)
        self._format = self._rules.format
        self._most_rise = self._rules.most_rise
        self._pool = CellPool(self._rules)
        self._times = CellTimes(config.map) if config.map.keep_times else None

    @classmethod
    def from_cells(cls, config: Config, indices: ArrayLike, log_odds: ArrayLike) -> VoxelMap:
        """Return a map of these cells: (N, 3) whole cell indices and (N,) log-odds, clamped as `config` says.

        A cell named twice keeps its last value; a log-odds of zero is stored as the smallest positive one.
        """
        voxel_map = cls(config)
        indices = np.asarray(indices, np.int64).reshape(-1, 3)
        blocks, of_cell = blocks_of_cells(indices)
        rules, unknown = voxel_map._rules, voxel_map._format.unknown
        stored = np.clip(voxel_map._format.stored(log_odds), rules.lowest, rules.highest)
        low = indices & (SIDE - 1)
        column = (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]
        cells = np.full((len(blocks), CELLS), unknown, voxel_map._format.dtype)
        cells[of_cell, column] = np.where(stored == unknown, unknown + 1, stored)
        voxel_map._pool.put(blocks.astype(np.int32), cells)
        return voxel_map

    def with_config(self, config: Config) -> VoxelMap:
        """Take over the settings of a run that goes on with this map.

        Raises ConfigError when they would change what its cells mean.
        """
        self.check_cells(config)
        self.config = config
        return self

    def unbounded(self, config: Config) -> VoxelMap:
        """Return a map without bounds of all cells and what is known of them, with the settings `config`.

        Raises ConfigError when these would change what its cells mean.
        """
        self.check_cells(config)
        return self._copied(config, self.slabs())

    def snapshot(self) -> VoxelMap:
        """Return a copy to look at while this map goes on: of all cells, or of those in the window."""
        return self._copied(self.config, self._pool.pieces())

    def take_history(self, earlier: VoxelMap) -> None:
        """Take over what `earlier` says of the frames that are in it."""
        self.history, self.viewpoint = earlier.history.copied(), earlier.viewpoint

    def check_cells(self, config: Config) -> None:
        """Raise ConfigError when `config` gives cells another meaning: their size or the `map` section."""
        for name in ("voxel_size", "steps", "map"):
            old, new = getattr(self.config, name), getattr(config, name)
            if old != new:
                raise ConfigError(f"cannot go on: the map was made with {name} {old}, now {new} is wanted")

    def look_from(self, viewpoint: Viewpoint) -> None:
        """Remember where the camera stands; a bounded map moves with it, cells without evidence for long go."""
        before, self.viewpoint = self.viewpoint, viewpoint
        if self._times is not None:
            self._times.forget(self._pool, (before or viewpoint).stamp_ns, viewpoint.stamp_ns)

    @property
    def cell_format(self) -> CellFormat:
        """What the log-odds of a cell are kept in."""
        return self._format

    @property
    def stored_cells(self) -> StoredCells:
        """What kernels that only read need; holds until the map changes."""
        return self._pool.stored_cells

    def insert(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole blocks: coordinates (n, 3), cells (n, 512) as stored; what stood there before is lost."""
        cells = np.clip(cells, self._rules.lowest, self._rules.highest)
        self._pool.put(coords, cells.astype(self._format.dtype, copy=False))
        if self._times is not None:
            self._times.remove(coords)

    def check_room(self, evidence: Evidence) -> None:
        """Raise FrameRefused `memory_full` where `evidence` needs more memory than the map may take."""

    def agreement(self, evidence: Evidence, firm: int) -> Agreement:
        """Return how far `evidence` agrees with what the map is sure of.

        firm: evidence of a hit, in thousandths, below which noise may have put it there.
        """
        return agreement(self.stored_cells, self._rules, evidence, firm)

    def add(self, evidence: Evidence) -> int:
        """Add what one frame says; return the number of cells whose value changed."""
        if not (len(evidence.coords) or len(evidence.uniform)):
            return 0
        mine = self._in_my_units(evidence)
        if self._times is not None:
            self._times.write(mine, self._now_ns)
        changed = self._pool.add(mine.coords, mine.values, mine.uniform, mine.uniform_values, self.config.threads)
        for listener in self.listeners:
            listener(mine)
        return changed

    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the log-odds (N,) at points (N, 3) in metres, world frame; 0 where unknown or not finite.

        Raises StereovoxError for what is not numbers (N, 3), or (3,) for one.
        """
        return self._format.log_odds(self._stored_at(queries.points_of(points)))

    def probability(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the occupancy probability (N,) at points (N, 3) in metres, world frame; 0.5 where unknown.

        Raises StereovoxError as `log_odds` does.
        """
        return np.asarray(1 / (1 + np.exp(-self.log_odds(points))), np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Return the `State` (N,) uint8 at points (N, 3) in metres, world frame; UNKNOWN where not finite.

        Raises StereovoxError as `log_odds` does.
        """
        return self._rules.states(self._stored_at(queries.points_of(points)))

    def age(self, points: ArrayLike, now_ns: int | None = None) -> NDArray[np.float32]:
        """Return how many seconds (N,) ago the cells at points (N, 3) got their last evidence, by frames' stamps.

        points: metres, world frame. now_ns: time in nanoseconds, by default that of the last frame. NaN where the cell
        is unknown or was put in without a time; negative where the evidence is stamped later than now.
        Raises StereovoxError where the map keeps no times, and as `log_odds` does.
        """
        points = queries.points_of(points)
        known = self._stored_at(points) != self._format.unknown
        return self._seconds_ago(np.where(known, self.times_at(points), NEVER), now_ns)

    def ages(self, now_ns: int | None = None) -> NDArray[np.float32]:
        """Return the `age` (N,) of all known cells, in the order of `cells`."""
        found = [cells_where(coords, times, cells != self._format.unknown) for coords, cells, times in self.timed()]
        indices, times = (np.concatenate(part) for part in zip(*found, strict=True))
        return self._seconds_ago(times[np.lexsort(indices.T[::-1])], now_ns)

    def cast_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_distance: float,
        stop_at: Iterable[State] = (State.OCCUPIED,),
    ) -> RayHits:
        """Return where rays stop: at the first cell in one of the states `stop_at` (not FREE), entered by then.

        origins: (N, 3), or (3,) for all rays; directions: (N, 3) of any length but zero; metres, world frame. A ray
        begins in the cell that holds its origin and looks at every cell it crosses; one that it touches in an edge
        only may count or not. max_distance: metres, may be infinite. Raises StereovoxError for bad input.
        """
        return queries.cast_rays(self._asked, origins, directions, max_distance, stop_at)

    def check_boxes(self, low: ArrayLike, high: ArrayLike) -> NDArray[np.uint8]:
        """Return the worst `State` (N,) uint8 in each box; worst is OCCUPIED, then TENTATIVE, UNKNOWN, FREE.

        low, high: (N, 3) corners in metres, world frame. A cell counts that holds a point of the box, faces included:
        what `state` would say of all points from low to high. Raises StereovoxError for bad input.
        """
        return queries.check_boxes(self._asked, low, high)

    def check_capsules(self, start: ArrayLike, end: ArrayLike, radius: ArrayLike) -> NDArray[np.uint8]:
        """Return the worst `State` (N,) uint8 that each capsule touches; worst is OCCUPIED, then TENTATIVE, UNKNOWN.

        start, end: (N, 3) ends of the axis in metres, world frame, the same for a ball; radius: metres, (N,) or one for
        all. A cell counts that is no farther from the axis than the radius. Raises StereovoxError for bad input.
        """
        return queries.check_capsules(self._asked, start, end, radius)

    def nearest_obstacle(
        self, points: ArrayLike, max_distance: float, obstacles: Iterable[State] = (State.OCCUPIED,)
    ) -> NearestCells:
        """Return how far the nearest cell is that is in one of the states `obstacles` (not FREE), and which it is.

        points: (N, 3) in metres, world frame; max_distance: metres, may be infinite. Raises StereovoxError for bad
        input.
        """
        return queries.nearest(self._asked, points, max_distance, obstacles)

    def cells(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return all known cells: indices (N, 3) int32 in ascending order, and their log-odds (N,)."""
        indices, stored = self._where(lambda values: values != self._format.unknown)
        return indices, self._format.log_odds(stored)

    def blocks(self) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return block coordinates (n, 3) in ascending order and their cells (n, 512) as they are stored."""
        coords, values = zip(*self.slabs(), strict=True)
        return np.concatenate(coords), np.concatenate(values)

    def blocks_within(self, low: ArrayLike, high: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return the blocks in memory with coordinates (3,) from `low` to below `high`, in no order.

        Coordinates (n, 3), cells (n, 512) as they are stored; both are copies.
        """
        return self._pool.within(np.asarray(low), np.asarray(high))

    def slabs(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
        """Yield all blocks as in `blocks`, piece by piece in ascending order.

        Where the map changes meanwhile, each piece is as it is at its time; hold `lock` to read one state.
        """
        yield from in_steps(self.lock, self._slabs())

    def timed(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32]]]:
        """Yield all blocks as `slabs` does, with the times (n, 512) of their cells, 0 where there is none.

        Raises StereovoxError where the map keeps no times. What they mean: `CellTimes`.
        """
        yield from in_steps(self.lock, self._timed())

    def times_of(self, coords: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Return the times (n, 512) of the cells of blocks (n, 3); they mean something where the cell is known."""
        return self._kept_times.get(coords)

    def set_times(self, coords: NDArray[np.int32], times: NDArray[np.uint32], start_ns: int | None) -> None:
        """Set the times (n, 512) of blocks (n, 3) that are in the map; they count from `start_ns`."""
        self._kept_times.put(coords, times)
        self._kept_times.start_ns = start_ns

    @property
    def times_start_ns(self) -> int | None:
        """Stamp in nanoseconds from which times of cells are counted; None before the first and where none are kept."""
        return None if self._times is None else self._times.start_ns

    def cells_in(self, state: State) -> NDArray[np.int32]:
        """Return the indices (N, 3) of the cells in a known state, block by block."""
        found = [cells_where(coords, stored, self._rules.states(stored) == state)[0] for coords, stored in self.slabs()]
        return np.concatenate(found)

    def centers(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of cells (N, 3)."""
        return (np.asarray(indices) + 0.5) * self.config.cell

    def occupied(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of all occupied cells."""
        return self._centers_of(State.OCCUPIED)

    def free(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of all free cells."""
        return self._centers_of(State.FREE)

    def __repr__(self) -> str:
        return self._described(
            self.config.cell if self.config.steps else self.config.cell[:1], self.counts(), self.memory_bytes
        )

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        number = np.zeros(4, np.int64)
        for _, values in self.slabs():
            states = self._rules.states(values)
            number += [np.count_nonzero(states == state) for state in State]
        return {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 3) in metres of all known cells; None for an empty map."""
        pieces = (_span(coords, values != self._format.unknown) for coords, values in self.slabs())
        spans = [span for span in pieces if span is not None]
        if not spans:
            return None
        lowest, highest = zip(*spans, strict=True)
        return np.stack([np.min(lowest, axis=0), np.max(highest, axis=0)]) * self.config.cell

    @property
    def memory_bytes(self) -> int:
        """Bytes the map uses: stored numbers, times, block coordinates and hash."""
        return self._pool.memory_bytes + (0 if self._times is None else self._times.memory_bytes)

    @property
    def reserved_bytes(self) -> int:
        """Bytes the map has taken: those in use, and room to grow (which the system gives when it is first used)."""
        return self._pool.reserved_bytes + (0 if self._times is None else self._times.reserved_bytes)

    def save(self, path: str | Path) -> None:
        """Save to the folder `path` (Zarr inside); an older map there stays whole until the new one is complete."""
        save_map(self, path)

    def close(self) -> None:
        """Give back what the map holds outside memory (nothing, unless it keeps tiles on disk)."""

    def _slabs(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
        """Yield what `slabs` does; the lock is held while an item is made."""
        yield from self._pool.pieces()

    def _timed(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32]]]:
        for coords, cells in self._slabs():
            times = self.times_of(coords)
            times[cells == self._format.unknown] = NEVER
            yield coords, cells, times

    def _in_my_units(self, evidence: Evidence) -> Evidence:
        """Return the evidence as differences of stored numbers; blocks that would get a uniform 0 are left out."""
        factor, most = self._format.per_log_odds / LOG_ODDS_SCALE, self._most_rise
        if factor == 1 and most is None and evidence.uniform_values.all():
            return evidence
        shift = self._format.shift(self.frames)
        values = np.empty_like(evidence.values)
        _add.rescale(evidence.values, np.float32(factor), np.float32(shift), np.float32(most or LARGEST), values)
        steps = np.floor(evidence.uniform_values * factor + shift).astype(np.int16)
        some = steps != 0
        return Evidence(evidence.coords, values, evidence.uniform[some], steps[some])

    @property
    def _now_ns(self) -> int:
        return 0 if self.viewpoint is None else self.viewpoint.stamp_ns

    def _copied(self, config: Config, blocks: Iterable[tuple[NDArray[np.int32], NDArray[np.integer]]]) -> VoxelMap:
        """Return a map without bounds of these of the map's blocks, and of what is known of them."""
        copy = VoxelMap(config)
        for coords, cells in blocks:
            copy.insert(coords, cells)
            if self._times is not None:
                copy.set_times(coords, self.times_of(coords), self.times_start_ns)
        copy.take_history(self)
        return copy

    @property
    def _kept_times(self) -> CellTimes:
        if self._times is None:
            raise StereovoxError("the map does not keep when cells were seen; make it with map.keep_times = true")
        return self._times

    def times_at(self, points: NDArray[np.floating]) -> NDArray[np.uint32]:
        """Return the times (N,) of the cells at points, NEVER where no cell can be."""
        times = np.zeros(len(points), np.uint32)
        within = (np.abs(points) < INDEX_LIMIT * np.array(self.config.cell)).all(axis=1)  # False for NaN
        cells = np.floor(points[within] / self.config.cell).astype(np.int64)
        blocks, of_cell = blocks_of_cells(cells)
        x, y, z = (cells & (SIDE - 1)).T
        times[within] = self.times_of(blocks.astype(np.int32))[of_cell, (x << 6) | (y << 3) | z]
        return times

    def _seconds_ago(self, times: NDArray[np.uint32], now_ns: int | None) -> NDArray[np.float32]:
        return self._kept_times.seconds_ago(times, self._now_ns if now_ns is None else now_ns)

    @property
    def _asked(self) -> Asked:
        return Asked(self.stored_cells, self._rules, self.config.cell)

    def _stored_at(self, points: NDArray[np.floating]) -> NDArray[np.integer]:
        return queries.stored_at(self.stored_cells, self.config.cell, points)

    def _centers_of(self, state: State) -> NDArray[np.float64]:
        return self.centers(self._where(lambda values: self._rules.states(values) == state)[0])

    def _where(
        self, chosen: Callable[[NDArray[np.integer]], NDArray[np.bool_]]
    ) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return indices (N, 3) of the cells whose stored numbers are `chosen`, in ascending order, and these (N,)."""
        found = [cells_where(coords, values, chosen(values)) for coords, values in self.slabs()]
        indices, stored = (np.concatenate(part) for part in zip(*found, strict=True))
        order = np.lexsort(indices.T[::-1])
        return indices[order], stored[order]


def cells_where(
    coords: NDArray[np.int32], values: NDArray[np.integer], chosen: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
    """Return indices (N, 3) and stored numbers (N,) of the `chosen` cells (n, 512) of blocks (n, 3)."""
    block, column = np.nonzero(chosen)
    low = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
    return (coords[block] * SIDE + low).astype(np.int32), values[block, column]


def _span(coords: NDArray[np.int32], known: NDArray[np.bool_]) -> tuple[list[int], list[int]] | None:
    """Return the lowest `known` cell (n, 512) of blocks (n, 3) on each axis, and the first beyond the highest."""
    if not known.any():
        return None
    known = known.reshape(-1, SIDE, SIDE, SIDE)
    ends = []
    for axis in range(3):
        layers = (coords[:, axis, None] * SIDE + np.arange(SIDE))[known.any(axis=tuple({1, 2, 3} - {axis + 1}))]
        ends.append((int(layers.min()), int(layers.max()) + 1))
    lowest, beyond = zip(*ends, strict=True)
    return list(lowest), list(beyond)


def load_map(path: str | Path) -> VoxelMap:
    """Read a map saved by `VoxelMap.save`, all of it, whatever window it was made in.

    Raises MapFileError: one line with the file and what is wrong.
    """
    saved = read_map(path)
    voxel_map = VoxelMap(saved.config)
    voxel_map.history, voxel_map.viewpoint, voxel_map.window_state = saved.history, saved.viewpoint, saved.window_state
    voxel_map.insert(saved.coords, saved.cells)
    if saved.times is not None:
        voxel_map.set_times(saved.coords, saved.times, saved.times_start_ns)
    return voxel_map
