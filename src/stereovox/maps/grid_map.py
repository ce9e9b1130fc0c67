# SPDX-License-Identifier: Apache-2.0
"""The 2-D occupancy grid of a floor: no frame to run out of, fixed-point log-odds in 16 or 8 bits a cell."""

from __future__ import annotations

import json
from math import isclose
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import se2
from stereovox.config import Config, load_config
from stereovox.errors import ConfigError, FrameRefused, MapFileError, StereovoxError
from stereovox.maps import _grid, _pool
from stereovox.maps.blocks import BlockPool
from stereovox.maps.cell_format import CellFormat, CellRules
from stereovox.maps.evidence import CELLS, LOG_ODDS_SCALE, SIDE, GridEvidence
from stereovox.maps.lock import only_writer_of
from stereovox.maps.memory import told
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.maps.voxel_map import INDEX_LIMIT, State
from stereovox.safe_io import json_value, read_arrays, replacing
from stereovox.threads import Guarded, MapLock
from stereovox.trust.history import History, WithHistory

FORMAT, VERSION = "stereovox-grid", 1
PARTS = ("about", "coords", "cells")


def save_grid(grid_map: GridMap, path: str | Path) -> None:
    """Write `grid_map` to the file `path`, all or nothing.

    Raises MapFileError, one line, where that cannot be or another run is writing it.
    """
    coords, cells = grid_map.tiles()
    about = np.frombuffer(json.dumps(_about(grid_map)).encode(), np.uint8)
    with only_writer_of(Path(path)), replacing(path) as file:
        np.savez_compressed(file, about=about, coords=coords, cells=cells)


def load_grid(path: str | Path) -> GridMap:
    """Read a grid saved by `GridMap.save`. Raises MapFileError: one line with the file and what is wrong."""
    pass  # REHOUSED

    try:
        parts = read_arrays(path, PARTS, "grid; make one with GridMap.save")
        about = json_value(parts["about"].tobytes())
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise ValueError(f"format {about['format']} {about['version']}, not {FORMAT} {VERSION}")
        grid_map = GridMap(load_config(about["config"]), about["origin"])
        grid_map.history = History.loaded(about)
        coords, cells = parts["coords"], parts["cells"]
        wanted = ((len(coords), 3), np.int32), ((len(coords), CELLS), grid_map.cell_format.dtype)
        for array, (shape, dtype) in zip((coords, cells), wanted, strict=True):
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(f"array of {array.shape} {array.dtype} where {shape} {np.dtype(dtype)} belongs")
        if not np.isfinite(grid_map.origin).all() or coords[:, 2].any() or (np.abs(coords) > 1 << 24).any():
            raise ValueError("tiles or origin out of range")
        if not (cells != grid_map.cell_format.unknown).any(axis=1).all():
            raise ValueError("a tile without a known cell")
        grid_map.insert(coords, cells)
    except MapFileError:
        raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception as error:  # what a damaged file can raise in zipfile, zlib, NumPy and JSON is not bounded
        why = " ".join(str(error).split()) or type(error).__name__
        raise MapFileError(f"{path}: no grid that can be read ({why}); save it anew") from None
    return grid_map


def _about(grid_map: GridMap) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "origin": grid_map.origin.tolist(),
        **grid_map.history.saved(),
        "config": grid_map.config.model_dump(),
    }


MAX_PICTURED = 2**29
"""Cells of the largest picture; the map itself holds only what was seen and may reach farther."""


class GridMap(Guarded, WithHistory):
    """A sparse 2-D occupancy map: tiles of 64x64 cells, made where a scan says something.

    Cell (i, j) covers `[i, i + 1) x [j, j + 1)` times `config.voxel_size` in the grid's own frame, which stands at
    `origin` (x, y, yaw) in the map's. Points and poses are in the map's frame. Cells, their states and the settings
    `config.map` mean what they do in a `VoxelMap`, but for the prior: that is `config.grid.prior`.
    `history` is what it remembers of the scans and images that made it.
    Several threads may use a map: each call holds its `lock`.
    """

    def __init__(self, config: Config, origin: ArrayLike = (0.0, 0.0, 0.0)):
        self.lock = MapLock()
        self.config = config
        self.voxel_size = config.voxel_size
        self.origin = np.array(origin, float).reshape(3)
        self.history = History()
        self._rules = CellRules(config.map.model_copy(update={"prior": config.grid.prior}))
        self._format = self._rules.format
        self._most_rise = self._rules.most_rise
        self._percent = Percent(self._rules)
        self._pool = BlockPool(self._format.dtype, capacity=64, fill=self._format.unknown, cells=CELLS)

    @classmethod
    def from_occupancy(cls, grid: OccupancyGrid, config: Config) -> GridMap:
        """Return a map to go on with: the cells of `grid`, whose frame it keeps, with the settings of `config`.

        0 and 100 per cent become the surest cells that `config.map` allows. Raises ConfigError for another cell size.
        """
        if not isclose(grid.resolution, config.voxel_size, rel_tol=1e-5):
            raise ConfigError(
                f"cannot go on: the map has cells of {grid.resolution:g} m, not {config.voxel_size:g}; "
                f"set voxel_size to {grid.resolution:g}"
            )
        grid_map = cls(config, grid.origin)
        rows, columns = grid.cells.shape
        tiles_up, tiles_across = -(-rows // SIDE), -(-columns // SIDE)
        cells = np.full((tiles_up * SIDE, tiles_across * SIDE), UNKNOWN, np.int8)
        cells[:rows, :columns] = grid.cells
        cells = cells.reshape(tiles_up, SIDE, tiles_across, SIDE).swapaxes(1, 2).reshape(-1, CELLS)
        known = np.flatnonzero((cells >= 0).any(axis=1))
        up, across = np.divmod(known, max(tiles_across, 1))
        grid_map.insert(np.column_stack([across, up, 0 * up]).astype(np.int32), grid_map._percent.stored(cells[known]))
        return grid_map

    def with_config(self, config: Config) -> GridMap:
        """Take over the settings of a run that goes on; raises ConfigError if they change what the cells mean."""
        for name in ("voxel_size", "map", "grid.prior"):
            old, new = (attrgetter(name)(settings) for settings in (self.config, config))
            if old != new:
                raise ConfigError(f"cannot go on: the map was made with {name} {old}, now {new} is wanted")
        self.config = config
        return self

    @property
    def cell_format(self) -> CellFormat:
        """What the log-odds of a cell are kept in."""
        return self._format

    def insert(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole tiles: coordinates (n, 3) x, y, 0; cells (n, 4096) as stored, at least one of each tile known.

        What stood there before is lost.
        """
        places = self._pool.insert(coords)
        known = np.clip(cells, self._rules.lowest, self._rules.highest)
        self._pool.values[places] = np.where(cells == self._format.unknown, self._format.unknown, known)

    def check_room(self, evidence: GridEvidence) -> None:
        """Raise FrameRefused `memory_full` where `evidence` needs more memory than `max_memory`.

        A third of that may hold tiles: where their pool grows, the old one and one twice as large stand side by side.
        """
        if self.config.max_memory is None:
            return
        pool, wanted = self._pool, np.ascontiguousarray(evidence.coords[evidence.values.any(axis=1)], np.int32)
        places = np.empty(len(wanted), np.int64)
        _pool.find_all(pool.table, pool.coords, wanted, places)
        needed = (len(pool) + int(np.count_nonzero(places < 0))) * pool.values[0].nbytes
        if 3 * needed > self.config.max_memory:
            raise FrameRefused(
                "memory_full",
                f"the grid would need {told(3 * needed)}, more than max_memory {told(self.config.max_memory)}; "
                "allow more or use larger cells",
            )

    def add(self, evidence: GridEvidence) -> int:
        """Add what one scan says (IST 2019, Eq 5); return the number of cells whose value changed."""
        values = evidence.values
        if self._format.per_log_odds != LOG_ODDS_SCALE:
            factor, shift = self._format.per_log_odds / LOG_ODDS_SCALE, self._format.shift(self.frames)
            values = np.floor(values * factor + shift).astype(np.int32)
        if self._most_rise is not None:
            values = np.minimum(values, values.dtype.type(self._most_rise))
        pool, rules = self._pool, self._rules
        pool.reserve(len(evidence.coords))
        return _grid.add_tiles(
            pool.table, pool.coords, pool.count, pool.values, evidence.coords, values,
            np.int32(self._format.unknown), rules.prior, rules.lowest, rules.highest,
        )  # fmt: skip

    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the log-odds (N,) at points (N, 2) in metres; 0 where unknown or not finite."""
        return self._format.log_odds(self._stored_at(points))

    def probability(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the occupancy probability (N,) at points (N, 2) in metres; 0.5 where unknown."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds(points))), np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Return the `State` (N,) uint8 at points (N, 2) in metres."""
        return self._rules.states(self._stored_at(points))

    def cells(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return all known cells: column and row (N, 2) in ascending order, and their log-odds (N,)."""
        coords, values = self.tiles()
        tile, place = np.nonzero(values != self._format.unknown)
        indices = coords[tile, :2].astype(np.int64) * SIDE + np.column_stack([place % SIDE, place // SIDE])
        order = np.lexsort(indices.T[::-1])
        return indices[order], self._format.log_odds(values[tile, place][order])

    def tiles(self) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return tile coordinates (n, 3) x, y, 0 in ascending order and their cells (n, 4096) as they are stored."""
        n = len(self._pool)
        order = np.lexsort(self._pool.coords[:n].T[::-1])
        return self._pool.coords[order], self._pool.values[order]

    def occupied(self) -> NDArray[np.float64]:
        """Return the centres (N, 2) in metres of all occupied cells."""
        return self._centres_of(State.OCCUPIED)

    def free(self) -> NDArray[np.float64]:
        """Return the centres (N, 2) in metres of all free cells."""
        return self._centres_of(State.FREE)

    def __repr__(self) -> str:
        return self._described((self.config.voxel_size,), self.counts(), self.memory_bytes)

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        number = np.bincount(self._rules.states(self._pool.values[: len(self._pool)]).ravel(), minlength=4)
        return {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 2) in metres of all known cells; None for an empty map.

        In the grid's own frame, which is the map's where `origin` is 0, 0, 0.
        """
        box = self._box()
        return None if box is None else np.asarray(box * self.voxel_size, float)

    def occupancy(self) -> OccupancyGrid:
        """Return all known cells as per cent, in a picture just large enough; no cells at all for an empty map.

        Cells are of the same state here and there (see `Percent`). Raises StereovoxError for more than MAX_PICTURED.
        """
        box = self._box()
        (left, bottom), (right, top) = np.zeros((2, 2), int).tolist() if box is None else box.tolist()
        if (top - bottom) * (right - left) > MAX_PICTURED:
            across, up = ((b - a) * self.voxel_size for a, b in ((left, right), (bottom, top)))
            raise StereovoxError(
                f"a map of {across:.0f} x {up:.0f} m has too many cells of {self.voxel_size:g} m for a picture; "
                "does the odometry jump? Else use larger cells"
            )
        picture = np.full((top - bottom, right - left), UNKNOWN, np.int8)
        n, percent = len(self._pool), self._percent
        _grid.show(self._pool.coords[:n], self._pool.values[:n], left, bottom, percent.shown, percent.lowest, picture)
        x, y, yaw = se2.compose(self.origin, [left * self.voxel_size, bottom * self.voxel_size, 0.0]).tolist()
        return OccupancyGrid(picture, self.voxel_size, (x, y, yaw), percent.free_below, percent.occupied_above)

    @property
    def memory_bytes(self) -> int:
        """Bytes the map needs in memory: cells, tile coordinates and hash."""
        return self._pool.memory_bytes

    def save(self, path: str | Path) -> None:
        """Save to the file `path` (`.npz`), exactly; an older file stays whole until the new one is complete.

        `load_grid` reads it. For other programs write `occupancy()` as map_server files.
        """
        pass  # REHOUSED

        save_grid(self, path)

    def _box(self) -> NDArray[np.int64] | None:
        """Return the lowest column and row of known cells, and one past the highest, (2, 2); None for an empty map."""
        n = len(self._pool)
        if not n:
            return None
        tiles = self._pool.coords[:n, :2].astype(np.int64)
        box = np.stack([tiles.min(axis=0), tiles.max(axis=0)])
        for end, axis in np.ndindex(2, 2):  # every tile has a known cell, so those at the rim tell
            rim = np.flatnonzero(tiles[:, axis] == box[end, axis])
            known = (self._pool.values[rim] != self._format.unknown).reshape(-1, SIDE, SIDE)
            there = np.flatnonzero(known.any(axis=(0, 1 + axis)))
            box[end, axis] = box[end, axis] * SIDE + (there[-1] + 1 if end else there[0])
        return box

    def _stored_at(self, points: ArrayLike) -> NDArray[np.integer]:
        points = np.asarray(points, float).reshape(-1, 2)
        with np.errstate(invalid="ignore"):
            indices = np.floor(se2.transform(se2.inverse(self.origin), points) / self.voxel_size)
        inside = (np.abs(indices) < INDEX_LIMIT).all(axis=1)
        stored = np.full(len(points), self._format.unknown, self._format.dtype)
        found = stored[inside]
        pool = self._pool
        _grid.look_up(pool.table, pool.coords, pool.values, indices[inside].astype(np.int64), found)
        stored[inside] = found
        return stored

    def _centres_of(self, state: State) -> NDArray[np.float64]:
        indices, log_odds = self.cells()
        chosen = indices[self._rules.states(self._format.stored(log_odds)) == state]
        return se2.transform(self.origin, (chosen + 0.5) * self.voxel_size)
