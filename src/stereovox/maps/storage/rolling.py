# SPDX-License-Identifier: Apache-2.0
"""A map in a window that moves with the camera: bounded memory, with cells outside dropped or kept in tiles on disk."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, WindowConfig
from stereovox.errors import ConfigError
from stereovox.frame import Viewpoint
from stereovox.maps.cells.cell_format import CellFormat
from stereovox.maps.cells.cell_pool import NEVER, CellPool, CellTimes
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.storage import _window
from stereovox.maps.storage.blocks import CELLS, SIDE, StoredCells
from stereovox.maps.storage.storage import Blocks, Storage
from stereovox.maps.storage.tiles import BLOCKS, INNER, TILE, Tile, TileStore, blocks_of, slabs_of
from stereovox.maps.storage.window import Box, Window, coarser, window_blocks, within_memory, without
from stereovox.maps.voxel_map import VoxelMap

TIMES = CellFormat(np.dtype(np.uint32), NEVER, 1.0)
"""Format of cell times in tiles."""


class RollingStorage(Storage):
    """The blocks of a window that moves with the camera, and tiles on disk for cells that left it; see `RollingMap`.

    All memory of the window is allocated at the start: `memory_bytes` never changes. Extra are up to `tiles.WAITING`
    tiles that wait for the disk, and, until the first frame places the window, the map of an earlier run.
    """

    bounded = True

    def __init__(self, config: Config, tiles: Path | None = None):
        super().__init__(config)
        self._settings = within_memory(config)  # the window's; `config` may derive it from memory
        self._window = Window(self._settings)
        capacity = window_blocks(self._settings)
        self._pool = CellPool(self.rules, capacity, capacity)
        self._times = CellTimes(config.map, capacity) if config.map.keep_times else None
        self._earlier: Storage | None = None
        self._store = self._times_store = None
        self._turned: list[int] = []  # stamps at which the clock was set back
        self._since: dict[Tile, int] = {}  # their number when a tile was written to disk
        if self._settings.window.outside == "keep":  # last: they leave folders
            self._store = TileStore(self.cell_format, tiles)
            self._times_store = self._store_of_times(self._store.folder / INNER)

    @property
    def window(self) -> NDArray[np.float64] | None:
        """Lowest and highest corner (2, 3) of the window in metres, None before the first frame."""
        return None if self._window.box is None else np.array(self._window.box) * self.config.cell

    @property
    def memory_bytes(self) -> int:
        """Bytes of the whole window, full or empty."""
        return self.reserved_bytes

    @property
    def tile_store(self) -> TileStore | None:
        """The store of cells outside the window, if they are kept."""
        return self._store

    @property
    def stored_cells(self) -> StoredCells:
        """The cells for read-only kernels: the window, or before it is placed the earlier map."""
        return super().stored_cells if self._earlier is None else self._earlier.stored_cells

    def go_on_with(self, earlier: Storage) -> None:
        """Start from the cells of an earlier map; they enter once the window is placed, and are the map until then.

        A window with the same settings continues where it was; any other is placed by the first frame. Raises
        ConfigError if the cells' meaning would change, or the map's record of its window is invalid.
        """
        earlier.check_cells(self.config)
        self.take_history(earlier)
        self._earlier = earlier
        if earlier.window_state is not None and _window_of(earlier.config) == self._settings.window:
            try:
                self._window.restore(earlier.window_state)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise ConfigError(
                    f"cannot continue: the map's window is damaged ({error}); make the map again"
                ) from None
            self.window_state = earlier.window_state
            self._take_over()
            self._rehearse()

    def replace_contents(self, other: Storage) -> None:
        """Take over all cells, the window and the tiles of a map of the same settings, which must no longer be used."""
        assert isinstance(other, RollingStorage)
        self.close()
        super().replace_contents(other)
        self._window, self._earlier, self._turned, self._since = other._window, None, other._turned, other._since
        self._store, self._times_store = other._store, other._times_store

    def set_viewpoint(self, viewpoint: Viewpoint) -> None:
        """Record the camera's pose and move the window after it.

        Raises MapFileError, and changes nothing, if an earlier tile could not be written.
        """
        for store in (self._store, self._times_store):
            if store is not None:
                store.check()
        if self._times_store is not None and self.viewpoint is not None:
            self._note_time(self.viewpoint.stamp_ns, viewpoint.stamp_ns)
        super().set_viewpoint(viewpoint)
        before = self._window.box
        position = viewpoint.T_world_camera[:3, 3].tolist()
        now = self._window.follow(position, viewpoint.stamp_ns)
        self.window_state = self._window.state
        if before is None:
            self._take_over()
            self._rehearse()
        elif now != before:
            self._move(before, now)

    def add(self, evidence: Evidence) -> int:
        """Add one frame's evidence on cells of the window; return the number of cells whose value changed."""
        return super().add(self._within(evidence))

    def times_of(self, coords: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Return the times (n, 512) of the cells of blocks (n, 3), in memory or on disk."""
        if self._earlier is not None:
            return self._earlier.times_of(coords)
        times = super().times_of(coords)
        if self._times_store is not None:
            tiles, of_block = np.unique(coords // BLOCKS, axis=0, return_inverse=True)
            for n, tile in enumerate(map(tuple, tiles.tolist())):
                if tile in self._times_store and not self._in_window(tile):
                    mine = of_block.ravel() == n
                    times[mine] = self._times_store.blocks_at(tile, coords[mine])
        return times

    @property
    def times_start_ns(self) -> int | None:
        """Stamp in nanoseconds from which times of cells are counted; None before the first and if none are kept."""
        return super().times_start_ns if self._earlier is None else self._earlier.times_start_ns

    def close(self) -> None:
        """Remove the tiles on disk; save the map first."""
        for store in (self._times_store, self._store):
            if store is not None:
                store.close()

    def _slabs(self) -> Iterator[Blocks]:
        """Yield all blocks, also those on disk, piece by piece in ascending order."""
        if self._earlier is not None:  # no frame has placed the window yet
            yield from self._earlier.slabs()
            return
        if self._store is None:
            yield from super()._slabs()
            return
        here = {tuple(tile) for tile in np.unique(self._pool.block_coords // BLOCKS, axis=0).tolist()}
        empty = True
        for slab in slabs_of(sorted(here | set(self._store.tiles()))):
            coords, cells = (np.concatenate(part) for part in zip(*map(self._tile, slab), strict=True))
            order = np.lexsort(coords.T[::-1])
            yield coords[order], cells[order]
            empty = False
        if empty:
            yield from super()._slabs()

    def _tile(self, tile: Tile) -> Blocks:
        """Return the blocks of a tile, wherever it is now."""
        coords, cells = self._pool.get(blocks_of(tile))
        if len(coords) or self._store is None or tile not in self._store or self._in_window(tile):
            return coords, cells
        return self._kept(tile)[:2]

    def stored_at(self, points: NDArray[np.floating]) -> NDArray[np.integer]:
        """Return the stored numbers (N,) of the cells at points (N, 3), in memory or on disk."""
        if self._earlier is not None:
            return self._earlier.stored_at(points)
        stored = super().stored_at(points)
        if self._store is not None:
            self._look_into_tiles(points, stored)
        return stored

    def _look_into_tiles(self, points: NDArray[np.floating], stored: NDArray[np.integer]) -> None:
        """Fill in cells unknown in the window from tiles, tile by tile."""
        assert self._store is not None
        within = (np.abs(points) < INDEX_LIMIT * np.array(self.config.cell)).all(axis=1)  # False for NaN
        asked = np.flatnonzero(within & (stored == self.cell_format.unknown))
        if not len(asked):
            return
        cells = np.floor(points[asked] / self.config.cell).astype(np.int64)
        tiles, of_cell, number = np.unique(cells // TILE, axis=0, return_inverse=True, return_counts=True)
        groups = np.split(np.argsort(of_cell.ravel(), kind="stable"), np.cumsum(number)[:-1])
        for tile, group in zip(map(tuple, tiles.tolist()), groups, strict=True):
            if tile in self._store and not self._in_window(tile):
                found = self._store.stored_at(tile, cells[group])
                if self._times_store is not None:
                    over = self._over(tile, self._times_store.stored_at(tile, cells[group]))
                    found = np.where(over, self.cell_format.unknown, found)
                stored[asked[group]] = found

    def _in_window(self, tile: Tile) -> bool:
        """Return whether the window touches a tile; its copy on disk is then out of date."""
        if self._window.box is None:
            return False
        low, high = coarser(self._window.box, TILE)
        return all(a <= t < b for a, t, b in zip(low, tile, high, strict=True))

    def _within(self, evidence: Evidence) -> Evidence:
        assert self._window.box is not None
        low, high = (np.array(corner, np.int32) for corner in self._window.box)
        n, m = len(evidence.coords), len(evidence.uniform)
        coords, values = np.empty((n + m, 3), np.int32), np.empty((n + m, CELLS), np.int16)
        uniform, uniform_values = np.empty((m, 3), np.int32), np.empty(m, np.int16)
        kept, whole = _window.clip(
            evidence.coords, evidence.values, evidence.uniform, evidence.uniform_values,
            low, high, coords, values, uniform, uniform_values,
        )  # fmt: skip
        return Evidence(
            coords[:kept], values[:kept], uniform[:whole], uniform_values[:whole], evidence.weak, evidence.again
        )

    def _move(self, before: Box, now: Box) -> None:
        if self._store is None:
            for slab in without(before, now):
                self._drop(slab, now)
            return
        tiles_before, tiles_now = coarser(before, TILE), coarser(now, TILE)
        for tile in _listed(tiles_before, tiles_now):
            self._put_away(tile)
        for tile in _listed(tiles_now, tiles_before):
            self._bring_back(tile)

    def _rehearse(self) -> None:
        """Perform an empty move, so that its kernels are compiled before the first real one."""
        assert self._window.box is not None
        if self._store is None:
            low = self._window.box[0]
            self._drop((low, low), self._window.box)
            return
        nowhere, nothing = np.empty((0, 3), np.int32), np.empty((0, CELLS), self.cell_format.dtype)
        self._pool.get(nowhere)
        self._pool.remove(nowhere)
        self.insert(nowhere, nothing)
        if self._times is not None:
            self._times.put(nowhere, self._times.get(nowhere))

    def _drop(self, slab: Box, now: Box) -> None:
        low, high, *window = (np.array(corner, np.int32) for corner in (*slab, *now))
        _window.vacate(*self._pool.arrays, np.int16(self.cell_format.unknown), self.rules.lowest, low, high, *window)
        if self._times is not None:
            self._times.follow(self._pool, low, high)

    def _put_away(self, tile: Tile) -> None:
        coords, cells = self._pool.get(blocks_of(tile))
        if len(coords) or (self._store is not None and tile in self._store):
            self._keep(tile, coords, cells, None if self._times is None else self._times.get(coords))
            self._pool.remove(coords)
            if self._times is not None:
                self._times.remove(coords)

    def _bring_back(self, tile: Tile) -> None:
        if self._store is not None and tile in self._store:
            coords, cells, times = self._kept(tile)
            self.insert(coords, cells)
            if self._times is not None and times is not None:
                self._times.put(coords, times)

    def _keep(
        self, tile: Tile, coords: NDArray[np.int32], cells: NDArray[np.integer], times: NDArray[np.uint32] | None
    ) -> None:
        """Write blocks of a tile to disk, with the times of their cells."""
        if self._store is not None:
            self._store.put(tile, coords, cells)
        if self._times_store is not None and times is not None:
            self._times_store.put(tile, coords, times)
            self._since[tile] = len(self._turned)

    def _kept(self, tile: Tile) -> tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.uint32] | None]:
        """Return the blocks of a tile on disk and the times of their cells; expired cells are unknown."""
        assert self._store is not None
        coords, cells = self._store.get(tile)
        if self._times_store is None:
            return coords, cells, None
        times = self._times_store.blocks_at(tile, coords)
        over = self._over(tile, times)
        cells, times = np.where(over, cells.dtype.type(self.cell_format.unknown), cells), np.where(over, NEVER, times)
        left = (cells != self.cell_format.unknown).any(axis=1)
        return coords[left], cells[left], times[left]

    def _note_time(self, before_ns: int, now_ns: int) -> None:
        assert self._times is not None
        if before_ns - now_ns > self._times.late_ns:
            self._turned += before_ns, now_ns

    def _over(self, tile: Tile, times: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return which cell times of a tile expired, now or since it left: a clock set back revives none."""
        assert self._times is not None
        moments = self._now_ns, *self._turned[self._since[tile] :]
        return self._times.expired(times, min(moments)) | self._times.expired(times, max(moments))

    def _store_of_times(self, folder: Path) -> TileStore | None:
        """Return the tiles that keep cell times."""
        if self._times is None:
            return None
        try:
            return TileStore(TIMES, folder)
        except BaseException:
            self.close()
            raise

    def _take_over(self) -> None:
        """Distribute the cells of an earlier map: into the window, into the tiles, or nowhere."""
        if self._earlier is None or self._window.box is None:
            return
        earlier, self._earlier = self._earlier, None
        coords, cells = earlier.blocks()
        times = None
        if self._times is not None:
            times, self._times.start_ns = earlier.times_of(coords), earlier.times_start_ns
        unit = TILE if self._store else SIDE
        low, high = np.array(coarser(self._window.box, unit)) * (unit // SIDE)
        inside = ((coords >= low) & (coords < high)).all(axis=1)
        self.insert(coords[inside], cells[inside])
        if self._times is not None and times is not None:
            self._times.put(coords[inside], times[inside])
        self._keep_others(coords[~inside], cells[~inside], None if times is None else times[~inside])
        if self._store is None:
            self._clear_borders()

    def _keep_others(
        self, coords: NDArray[np.int32], cells: NDArray[np.integer], times: NDArray[np.uint32] | None
    ) -> None:
        if self._store is None or not len(coords):
            return
        tiles, of_block = np.unique(coords // BLOCKS, axis=0, return_inverse=True)
        for n, tile in enumerate(tiles.tolist()):
            mine = of_block.ravel() == n
            self._keep(tuple(tile), coords[mine], cells[mine], None if times is None else times[mine])

    def _clear_borders(self) -> None:
        assert self._window.box is not None
        (a, b, c), (d, e, f) = coarser(self._window.box, SIDE)
        around = (SIDE * a, SIDE * b, SIDE * c), (SIDE * d, SIDE * e, SIDE * f)
        for slab in without(around, self._window.box):
            self._drop(slab, self._window.box)


class RollingMap(VoxelMap):
    """A map whose cells are updated only within a window (Chien 2020, 3.6: map shifting).

    With `window.outside = "drop"` cells that leave become unknown; with "keep" they go to tiles on disk (`tiles`: the
    folder, a temporary one by default) and return with the window. All memory of the window is allocated at the start:
    `memory_bytes` never changes. Queries work anywhere; cells in tiles are read from disk, which is slow. `close`
    removes the tiles.
    """

    storage: RollingStorage  # pyrefly: ignore[bad-override-mutable-attribute] - set once

    def __init__(self, config: Config, tiles: Path | None = None):
        super().__init__(config, storage=RollingStorage(config, tiles))

    @property
    def window(self) -> NDArray[np.float64] | None:
        """Lowest and highest corner (2, 3) of the window in metres, None before the first frame."""
        return self.storage.window


def _window_of(config: Config) -> WindowConfig:
    """Return the window of a map made with these settings; the setting itself if they no longer give one."""
    try:
        return within_memory(config).window
    except ConfigError:
        return config.window


def _listed(box: Box, other: Box) -> Iterator[Tile]:
    """Yield the tiles of `box` that are not in `other`."""
    for low, high in without(box, other):
        yield from product(range(low[0], high[0]), range(low[1], high[1]), range(low[2], high[2]))
