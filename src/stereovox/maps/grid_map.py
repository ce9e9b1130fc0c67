# SPDX-License-Identifier: Apache-2.0
"""The 2-D occupancy grid of a floor: unbounded, sparse, fixed-point log-odds in 16 or 8 bits a cell."""

from __future__ import annotations

import zlib
from math import isclose
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config, load_config
from stereovox.errors import ConfigError, FrameRefused, MapFileError, StereovoxError
from stereovox.files.safe_io import read_arrays, replacing, sealed, unsealed
from stereovox.geometry import se2
from stereovox.kernels.threads import Guarded, MapLock
from stereovox.maps import _grid
from stereovox.maps.cells import _pool
from stereovox.maps.cells.cell_format import CellRules, State
from stereovox.maps.cells.evidence import CELLS, LOG_ODDS_SCALE, SIDE, GridEvidence
from stereovox.maps.files.lock import only_writer_of
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.maps.query.queries import INDEX_LIMIT, points_of, shape_error
from stereovox.maps.record.glance import BeamAgreement
from stereovox.maps.record.history import History
from stereovox.maps.storage.blocks import BlockPool
from stereovox.maps.storage.storage import OnStorage
from stereovox.maps.storage.window import format_bytes

FORMAT, VERSION = "stereovox-grid", 2
PARTS = ("about", "coords", "cells")
BEAMS, DEEP_CELLS = 181, 4.0
"""Most beams that a scan is judged by, and cells from a surface that a beam passes to where it ends."""
MAX_PICTURED = 2**29
"""Cells of the largest picture; the map itself stores only known tiles and may extend farther."""


class GridStorage(Guarded):
    """The tiles of a grid in memory.

    Attributes:
        lock: Held during each call, and each call of the map.
        config: The settings.
        history: The map's record of its scans and images.
        rules: Meaning of stored numbers.
        cell_format: How log-odds are stored.
    """

    def __init__(self, config: Config):
        self.lock = MapLock()
        self.config = config
        self.history = History()
        self.rules = CellRules(config.map.model_copy(update={"prior": config.grid.prior}))
        self.cell_format = self.rules.format
        self._most_rise = self.rules.most_rise
        unknown, (free, _, occupied) = self.cell_format.unknown, map(np.int32, self.rules.sure)
        self._surface = np.int32(max(self.rules.prior, self.rules.thresholds.free_most, unknown) + 1)
        self._sure, self._counts = (np.int32(unknown), (self._surface, free), occupied), np.zeros(4, np.int64)
        self._any = np.int32(unknown), (self._surface, np.int32(self._surface - 1)), self._surface
        self._pool = self._empty()

    def _empty(self) -> BlockPool:
        return BlockPool(self.cell_format.dtype, capacity=64, fill=self.cell_format.unknown, cells=CELLS)

    def begin_anew(self) -> None:
        """Empty the map, and its history, whose scans none has confirmed."""
        self._pool = self._empty()
        self.history.begin_anew()

    def continue_with(self, config: Config) -> None:
        """Adopt the settings of a run that continues the map; raises ConfigError if they change the cells' meaning."""
        for name in ("voxel_size", "map", "grid.prior"):
            old, new = (attrgetter(name)(settings) for settings in (self.config, config))
            if old != new:
                raise ConfigError(f"cannot continue: the map was made with {name} {old}, the new setting is {new}")
        self.config = config

    def insert(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole tiles: coordinates (n, 3) x, y, 0; cells (n, 4096) as stored, at least one of each tile known.

        Earlier content is lost.
        """
        places = self._pool.insert(coords)
        known = np.clip(cells, self.rules.lowest, self.rules.highest)
        self._pool.values[places] = np.where(cells == self.cell_format.unknown, self.cell_format.unknown, known)

    def check_room(self, evidence: GridEvidence) -> None:
        """Raise FrameRefused `memory_full` if `evidence` needs more memory than `max_memory`.

        Tiles may take a third of that: while their pool grows, the old and a doubled one exist together.
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
                f"the grid would need {format_bytes(3 * needed)}, "
                f"more than max_memory {format_bytes(self.config.max_memory)}; allow more or use larger cells",
            )

    def agreement(self, evidence: GridEvidence, around: int, sure: bool = True) -> BeamAgreement:
        """Return how a scan agrees with what is surely known, or with all that is known.

        around: cells from a surface that are on it.
        """
        if evidence.ends is None:
            return BeamAgreement(0, 0, 0, 0)
        pool, ends, counts = self._pool, evidence.ends, self._counts
        step = -(-len(ends) // BEAMS)
        limits = self._sure if sure else self._any
        _grid.weigh(pool.table, pool.coords, pool.values, *limits, around, DEEP_CELLS, ends, step, counts)
        return BeamAgreement(*counts.tolist())

    def seen_at(self, indices: NDArray[np.int64], around: int) -> NDArray[np.uint8]:
        """Return OCCUPIED for cells, column and row (N, 2), up to `around` from a surface, FREE and UNKNOWN for others.

        A surface is what is likelier than before the first evidence, and not free.
        """
        pool, found = self._pool, np.empty(len(indices), np.uint8)
        limits = self._surface, self.rules.thresholds.free_most
        unknown = np.int32(self.cell_format.unknown)
        _grid.see(pool.table, pool.coords, pool.values, unknown, limits, indices, around, found)
        return found

    def cast(self, lines: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far (0 to 1) lines (N, 4), x, y to x, y in cells, run to an occupied cell; inf without one."""
        pool, found, unknown = self._pool, np.empty(len(lines)), np.int32(self.cell_format.unknown)
        _grid.cast(pool.table, pool.coords, pool.values, unknown, self.rules.thresholds.occupied_least, lines, found)
        return found

    def surfaces(self, left: int, bottom: int, rows: int, columns: int) -> NDArray[np.bool_]:
        """Return which cells (rows, columns) from column `left` and row `bottom` on are surfaces, as for `seen_at`."""
        picture, n = np.zeros((rows, columns), np.int8), len(self._pool)
        lowest, highest = np.iinfo(self.cell_format.dtype).min, np.iinfo(self.cell_format.dtype).max
        shown = (np.arange(lowest, highest + 1) >= self._surface).astype(np.int8)
        _grid.show(self._pool.coords[:n], self._pool.values[:n], left, bottom, shown, int(lowest), picture)
        return picture.view(bool)

    def add(self, evidence: GridEvidence) -> int:
        """Add the evidence of one scan (IST 2019, Eq 5); return the number of cells whose value changed."""
        values = evidence.values
        if evidence.weak:
            values = self.rules.yielding(values, self._cells_of(evidence.coords), evidence.again)
        if self.cell_format.per_log_odds != LOG_ODDS_SCALE:
            factor, shift = self.cell_format.per_log_odds / LOG_ODDS_SCALE, self.cell_format.shift(self.history.frames)
            values = np.floor(values * factor + shift).astype(np.int32)
        if self._most_rise is not None:
            values = np.minimum(values, values.dtype.type(self._most_rise))
        pool, rules = self._pool, self.rules
        pool.reserve(len(evidence.coords))
        return _grid.add_tiles(
            pool.table, pool.coords, pool.count, pool.values, evidence.coords, values,
            np.int32(self.cell_format.unknown), rules.prior, rules.lowest, rules.highest,
        )  # fmt: skip

    def _cells_of(self, coords: NDArray[np.int32]) -> NDArray[np.integer]:
        """Return the cells (n, 4096) of tiles (n, 3) as stored."""
        places = np.empty(len(coords), np.int64)
        _pool.find_all(self._pool.table, self._pool.coords, coords, places)
        cells = np.full((len(coords), CELLS), self.cell_format.unknown, self.cell_format.dtype)
        cells[places >= 0] = self._pool.values[places[places >= 0]]
        return cells

    def stored_at(self, indices: NDArray[np.integer]) -> NDArray[np.integer]:
        """Return the stored numbers (N,) of cells, column and row (N, 2); "unknown" if there is no tile."""
        found = np.full(len(indices), self.cell_format.unknown, self.cell_format.dtype)
        pool = self._pool
        _grid.look_up(pool.table, pool.coords, pool.values, np.ascontiguousarray(indices, np.int64), found)
        return found

    @property
    def values(self) -> NDArray[np.integer]:
        """Cells (n, 4096) of all tiles as stored, in no order; valid until the map changes."""
        return self._pool.values[: len(self._pool)]

    def tiles(self) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return tile coordinates (n, 3) x, y, 0 in ascending order and their cells (n, 4096) as stored."""
        n = len(self._pool)
        order = np.lexsort(self._pool.coords[:n].T[::-1])
        return self._pool.coords[order], self._pool.values[order]

    def box(self) -> NDArray[np.int64] | None:
        """Return the lowest column and row of known cells, and one past the highest, (2, 2); None for an empty map."""
        n = len(self._pool)
        if not n:
            return None
        tiles = self._pool.coords[:n, :2].astype(np.int64)
        box = np.stack([tiles.min(axis=0), tiles.max(axis=0)])
        for end, axis in np.ndindex(2, 2):  # every tile has a known cell, so the outermost decide
            rim = np.flatnonzero(tiles[:, axis] == box[end, axis])
            known = (self._pool.values[rim] != self.cell_format.unknown).reshape(-1, SIDE, SIDE)
            there = np.flatnonzero(known.any(axis=(0, 1 + axis)))
            box[end, axis] = box[end, axis] * SIDE + (there[-1] + 1 if end else there[0])
        return box

    def paint(self, left: int, bottom: int, percent: Percent, picture: NDArray[np.int8]) -> None:
        """Write the cells as per cent into a picture (rows, columns) whose first cell is `left`, `bottom`."""
        n = len(self._pool)
        _grid.show(self._pool.coords[:n], self._pool.values[:n], left, bottom, percent.shown, percent.lowest, picture)

    @property
    def memory_bytes(self) -> int:
        """Bytes in use: cells, tile coordinates and hash."""
        return self._pool.memory_bytes


class GridMap(Guarded, OnStorage):
    """A sparse 2-D occupancy map: tiles of 64x64 cells, created on demand.

    Cell (i, j) covers `[i, i + 1) x [j, j + 1)` times `config.voxel_size` in the grid's own frame, whose pose in the
    map's frame is `origin`. Points and poses are in the map's frame. Cells, their states and the settings `config.map`
    mean the same as in a `VoxelMap`, except the prior: that is `config.grid.prior`.

    Several threads may use a map: each call holds its `lock`.

    Args:
        config: The settings.
        origin: (3,) x, y in metres and yaw in radians of the grid's frame in the map's.

    Raises:
        StereovoxError: `origin` has another shape.

    Attributes:
        lock: Re-entrant; hold it over several calls that must see the same state.
        origin: As given, float64.
        storage: The stored tiles, for programs that read or write whole tiles.
    """

    storage: GridStorage

    def __init__(self, config: Config, origin: ArrayLike = (0.0, 0.0, 0.0)):
        self.storage = GridStorage(config)
        self.lock = self.storage.lock
        self.origin = np.array(origin, float)
        if self.origin.shape != (3,):
            raise shape_error("origin", self.origin, "(3,): x, y in metres and yaw in radians")
        self._percent = Percent(self.storage.rules)

    @classmethod
    def from_occupancy(cls, grid: OccupancyGrid, config: Config) -> GridMap:
        """Make a map from a grid, to continue it.

        Args:
            grid: The cells, and the frame that the map keeps. 0 and 100 per cent become the most certain cells that
                `config.map` allows.
            config: The settings.

        Returns:
            The map, of no frames.

        Raises:
            ConfigError: `grid` has another cell size than `config`.
        """
        if not isclose(grid.resolution, config.voxel_size, rel_tol=1e-5):
            raise ConfigError(
                f"cannot continue: the map has cells of {grid.resolution:g} m, not {config.voxel_size:g}; "
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
        grid_map.storage.insert(
            np.column_stack([across, up, 0 * up]).astype(np.int32), grid_map._percent.stored(cells[known])
        )
        return grid_map

    def add(self, evidence: GridEvidence) -> int:
        """Add the evidence of one scan.

        Args:
            evidence: Evidence of a scan's beams.

        Returns:
            The number of cells whose value changed.
        """
        return self.storage.add(evidence)

    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Look up log-odds.

        Args:
            points: (N, 2) in metres, or (2,) for one.

        Returns:
            (N,) float32; 0 if unknown or not finite.

        Raises:
            StereovoxError: `points` is not numbers of such a shape.
        """
        return self.storage.cell_format.log_odds(self._stored_at(points))

    def probability(self, points: ArrayLike) -> NDArray[np.float32]:
        """Look up occupancy probabilities.

        Args:
            points: (N, 2) in metres, or (2,) for one.

        Returns:
            (N,) float32; 0.5 if unknown or not finite.

        Raises:
            StereovoxError: `points` is not numbers of such a shape.
        """
        return np.asarray(1 / (1 + np.exp(-self.log_odds(points))), np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Look up the `State` of cells.

        Args:
            points: (N, 2) in metres, or (2,) for one.

        Returns:
            (N,) uint8; UNKNOWN if not finite.

        Raises:
            StereovoxError: `points` is not numbers of such a shape.
        """
        return self.storage.rules.states(self._stored_at(points))

    def cells(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return all known cells.

        Returns:
            Column and row (N, 2) int64 in ascending order, and their log-odds (N,) float32.
        """
        coords, values = self.storage.tiles()
        cell_format = self.storage.cell_format
        tile, place = np.nonzero(values != cell_format.unknown)
        indices = coords[tile, :2].astype(np.int64) * SIDE + np.column_stack([place % SIDE, place // SIDE])
        order = np.lexsort(indices.T[::-1])
        return indices[order], cell_format.log_odds(values[tile, place][order])

    def occupied(self) -> NDArray[np.float64]:
        """Return the centres (N, 2) in metres of all occupied cells."""
        return self._centres_of(State.OCCUPIED)

    def free(self) -> NDArray[np.float64]:
        """Return the centres (N, 2) in metres of all free cells."""
        return self._centres_of(State.FREE)

    def __repr__(self) -> str:
        return self._described((self.config.voxel_size,), self.counts(), self.memory_bytes)

    def _repr_html_(self, title: str | None = None) -> str:
        """Return the notebook view: a small picture from above, and facts. title: by default the class's name."""
        from stereovox.maps.notebook import card, facts_of, floor_from_above

        with self.lock:
            facts = facts_of((self.voxel_size,), self.counts(), self.bounds(), self.memory_bytes, self.history)
            box = self.storage.box()
            size = np.zeros(2, int) if box is None else box[1] - box[0]
            picture = floor_from_above(size[::-1], lambda: self.occupancy().states)
        return card(title or type(self).__name__, facts, *picture)

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        number = np.bincount(self.storage.rules.states(self.storage.values).ravel(), minlength=4)
        return {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 2) in metres of all known cells; None for an empty map.

        In the grid's own frame, which is the map's if `origin` is 0, 0, 0.
        """
        box = self.storage.box()
        return None if box is None else np.asarray(box * self.voxel_size, float)

    def occupancy(self) -> OccupancyGrid:
        """Return all known cells as per cent, in a picture just large enough; no cells at all for an empty map.

        Cells keep their state (see `Percent`). Raises StereovoxError for more than MAX_PICTURED.
        """
        box = self.storage.box()
        (left, bottom), (right, top) = np.zeros((2, 2), int).tolist() if box is None else box.tolist()
        if (top - bottom) * (right - left) > MAX_PICTURED:
            across, up = ((b - a) * self.voxel_size for a, b in ((left, right), (bottom, top)))
            raise StereovoxError(
                f"a map of {across:.0f} x {up:.0f} m has too many cells of {self.voxel_size:g} m for a picture; "
                "does the odometry jump? Else use larger cells"
            )
        picture = np.full((top - bottom, right - left), UNKNOWN, np.int8)
        self.storage.paint(left, bottom, self._percent, picture)
        percent = self._percent
        x, y, yaw = se2.compose(self.origin, [left * self.voxel_size, bottom * self.voxel_size, 0.0]).tolist()
        return OccupancyGrid(picture, self.voxel_size, (x, y, yaw), percent.free_below, percent.occupied_above)

    @property
    def memory_bytes(self) -> int:
        """Bytes the map uses: cells, tile coordinates and hash."""
        return self.storage.memory_bytes

    def save(self, path: str | Path) -> None:
        """Save the map exactly; an older file stays whole until the new one is complete.

        `load_grid` reads it. For other programs write `occupancy()` as map_server files.

        Args:
            path: The file (`.npz`).

        Raises:
            MapFileError: It cannot be written, or is being written by another run.
        """
        save_grid(self, path)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name == "insert":  # was once reached here
                return self.storage.insert
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")

    def _stored_at(self, points: ArrayLike) -> NDArray[np.integer]:
        points = points_of(points, axes=2)
        with np.errstate(invalid="ignore"):
            indices = np.floor(se2.transform(se2.inverse(self.origin), points) / self.voxel_size)
        inside = (np.abs(indices) < INDEX_LIMIT).all(axis=1)
        stored = np.full(len(points), self.storage.cell_format.unknown, self.storage.cell_format.dtype)
        stored[inside] = self.storage.stored_at(indices[inside].astype(np.int64))
        return stored

    def _centres_of(self, state: State) -> NDArray[np.float64]:
        indices, log_odds = self.cells()
        storage = self.storage
        chosen = indices[storage.rules.states(storage.cell_format.stored(log_odds)) == state]
        return se2.transform(self.origin, (chosen + 0.5) * self.voxel_size)


def save_grid(grid_map: GridMap, path: str | Path) -> None:
    """Write `grid_map` to the file `path`, all or nothing.

    Raises MapFileError, one line, if that fails or another run is writing it.
    """
    coords, cells = grid_map.storage.tiles()
    about = np.frombuffer(sealed({**_about(grid_map), "checksum": _checksums(coords, cells)}), np.uint8)
    with only_writer_of(Path(path)), replacing(path) as file:
        np.savez_compressed(file, about=about, coords=coords, cells=cells)


def load_grid(path: str | Path) -> GridMap:
    """Read a grid saved by `GridMap.save`. Raises MapFileError: one line with the file and what is wrong."""
    try:
        parts = read_arrays(path, PARTS, "grid; make one with GridMap.save")
        about = unsealed(parts["about"].tobytes())
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise ValueError(f"format {about['format']} {about['version']}, not {FORMAT} {VERSION}")
        grid_map = GridMap(load_config(about["config"]), about["origin"])
        grid_map.history = History.loaded(about)
        coords, cells = parts["coords"], parts["cells"]
        wanted = ((len(coords), 3), np.int32), ((len(coords), CELLS), grid_map.storage.cell_format.dtype)
        for array, (shape, dtype) in zip((coords, cells), wanted, strict=True):
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(f"array of {array.shape} {array.dtype} where {shape} {np.dtype(dtype)} belongs")
        if not np.isfinite(grid_map.origin).all() or coords[:, 2].any() or (np.abs(coords) > 1 << 24).any():
            raise ValueError("tiles or origin out of range")
        if not (cells != grid_map.storage.cell_format.unknown).any(axis=1).all():
            raise ValueError("a tile has no known cell")
        if _checksums(coords, cells) != about["checksum"]:
            raise ValueError("the cells do not match their checksum")
        grid_map.storage.insert(coords, cells)
    except MapFileError:
        raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception as error:  # a damaged file can raise anything in zipfile, zlib, NumPy and JSON
        why = " ".join(str(error).split()) or type(error).__name__
        raise MapFileError(f"{path}: not a readable grid ({why}); save it again") from None
    return grid_map


def _checksums(*arrays: NDArray[Any]) -> list[int]:
    return [zlib.crc32(np.ascontiguousarray(array).data) for array in arrays]


def _about(grid_map: GridMap) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "origin": grid_map.origin.tolist(),
        **grid_map.history.saved(),
        "config": grid_map.config.model_dump(),
    }
