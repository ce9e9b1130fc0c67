# SPDX-License-Identifier: Apache-2.0
"""The voxel map: unbounded, sparse, fixed-point log-odds in 16 or 8 bits a cell."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import ConfigError
from stereovox.frame import Viewpoint
from stereovox.maps import _cpu
from stereovox.maps.blocks import SIDE, BlockPool, StoredCells
from stereovox.maps.cell_format import CellFormat, CellRules
from stereovox.maps.cell_format import State as State
from stereovox.maps.evidence import LOG_ODDS_SCALE, Evidence

INDEX_LIMIT = 2**30
"""Cell indices lie in [-INDEX_LIMIT, INDEX_LIMIT); beyond it everything is unknown."""


class VoxelMap:
    """A sparse occupancy map in the world frame (z up unless the recording says otherwise).

    Cell i covers [i, i + 1) * voxel_size on each axis, or of `config.cell` where its sides differ. A cell without
    evidence is unknown: log-odds 0, probability 0.5. With evidence it is free (p < free_below), occupied
    (p > occupied_above) or tentative between them.
    `config` holds the settings the map was made with, `frames` the number of frames that are in it, `frames_refused`
    the number that were offered and refused, `recording` the name of what they came from, if known, `viewpoint` where
    the camera stood last, `window_state` where its window was, if it had one.
    """

    def __init__(self, config: Config):
        self.config = config
        self.voxel_size = config.voxel_size
        self.frames = 0
        self.frames_refused = 0
        self.recording = ""
        self.viewpoint: Viewpoint | None = None
        self.window_state: dict[str, Any] | None = None
        self._rules = CellRules(config.map)
        self._format = self._rules.format
        self._pool = BlockPool(self._format.dtype, fill=self._format.unknown)

    @classmethod
    def from_cells(cls, config: Config, indices: ArrayLike, log_odds: ArrayLike) -> VoxelMap:
        """Return a map of these cells: (N, 3) whole cell indices and (N,) log-odds, clamped as `config` says.

        A cell named twice keeps its last value; a log-odds of zero is stored as the smallest positive one.
        """
        voxel_map = cls(config)
        indices = np.asarray(indices, np.int64).reshape(-1, 3)
        blocks, of_cell = np.unique(indices >> 3, axis=0, return_inverse=True)
        places = voxel_map._pool.insert(blocks.astype(np.int32))
        rules, unknown = voxel_map._rules, voxel_map._format.unknown
        stored = np.clip(voxel_map._format.stored(log_odds), rules.lowest, rules.highest)
        low = indices & (SIDE - 1)
        column = (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]
        voxel_map._pool.values[places[of_cell.ravel()], column] = np.where(stored == unknown, unknown + 1, stored)
        return voxel_map

    def with_config(self, config: Config) -> VoxelMap:
        """Take over the settings of a run that goes on with this map.

        Raises ConfigError when they would change what its cells mean.
        """
        self.check_cells(config)
        self.config = config
        return self

    def check_cells(self, config: Config) -> None:
        """Raise ConfigError when `config` gives cells another meaning: their size or the `map` section."""
        for name in ("voxel_size", "steps", "map"):
            old, new = getattr(self.config, name), getattr(config, name)
            if old != new:
                raise ConfigError(f"cannot go on: the map was made with {name} {old}, now {new} is wanted")

    def look_from(self, viewpoint: Viewpoint) -> None:
        """Remember where the camera stands; a bounded map moves with it."""
        self.viewpoint = viewpoint

    @property
    def cell_format(self) -> CellFormat:
        """What the log-odds of a cell are kept in."""
        return self._format

    @property
    def stored_cells(self) -> StoredCells:
        """What kernels that only read need; holds until the map changes."""
        pool, unknown = self._pool, np.int32(self._format.unknown)
        return StoredCells(pool.table, pool.coords, pool.values, unknown, self._rules.lowest)

    def insert(self, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Set whole blocks: coordinates (n, 3), cells (n, 512) as stored; what stood there before is lost."""
        places = self._pool.insert(coords)
        self._pool.values[places] = np.clip(cells, self._rules.lowest, self._rules.highest)
        self._pool.flags[places] = 0

    def add(self, evidence: Evidence) -> int:
        """Add what one frame says; return the number of cells whose value changed."""
        values, uniform = self._in_my_units(evidence)
        pool, rules, unknown = self._pool, self._rules, self._format.unknown
        self._make_room(len(evidence.coords) + len(evidence.uniform))
        blocks = (pool.table, pool.coords, pool.count, pool.values, pool.flags)
        changed = _cpu.add_values(*blocks, evidence.coords, values, unknown, rules.prior, rules.lowest, rules.highest)
        if uniform:
            changed += _cpu.add_constant(*blocks, evidence.uniform, uniform, unknown, rules.prior, rules.lowest)
        return changed

    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the log-odds (N,) at points (N, 3) in metres, world frame; 0 where unknown or not finite."""
        return self._format.log_odds(self._stored_at(points))

    def probability(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the occupancy probability (N,) at points (N, 3) in metres, world frame; 0.5 where unknown."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds(points))), np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Return the `State` (N,) uint8 at points (N, 3) in metres, world frame."""
        return self._rules.states(self._stored_at(points))

    def cells(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return all known cells: indices (N, 3) int32 in ascending order, and their log-odds (N,)."""
        coords, values = self.blocks()
        block, column = np.nonzero(values != self._format.unknown)
        low = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
        indices = (coords[block] * SIDE + low).astype(np.int32)
        order = np.lexsort(indices.T[::-1])
        return indices[order], self._format.log_odds(values[block, column][order])

    def blocks(self) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return block coordinates (n, 3) in ascending order and their cells (n, 512) as they are stored."""
        coords, values = zip(*self.slabs(), strict=True)
        return np.concatenate(coords), np.concatenate(values)

    def slabs(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
        """Yield all blocks as in `blocks`, piece by piece in ascending order."""
        n = len(self._pool)
        order = np.lexsort(self._pool.coords[:n].T[::-1])
        yield self._pool.coords[order], self._pool.values[order]

    def centers(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of cells (N, 3)."""
        return (np.asarray(indices) + 0.5) * self.config.cell

    def occupied(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of all occupied cells."""
        return self._centers_of(State.OCCUPIED)

    def free(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of all free cells."""
        return self._centers_of(State.FREE)

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        number = np.zeros(4, np.int64)
        for _, values in self.slabs():
            number += np.bincount(self._rules.states(values).ravel(), minlength=4)
        return {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 3) in metres of all known cells; None for an empty map."""
        indices, _ = self.cells()
        if not len(indices):
            return None
        return np.stack([indices.min(0), indices.max(0) + 1]) * self.config.cell

    @property
    def memory_bytes(self) -> int:
        """Bytes the map needs in memory: cells, block coordinates and hash."""
        return self._pool.memory_bytes

    def save(self, path: str | Path) -> None:
        """Save to the folder `path` (Zarr inside); an older map there stays whole until the new one is complete."""
        from stereovox.maps.store import save_map

        save_map(self, path)

    def close(self) -> None:
        """Give back what the map holds outside memory (nothing, unless it keeps tiles on disk)."""

    def _in_my_units(self, evidence: Evidence) -> tuple[NDArray[np.int16], np.int32]:
        """Return the values of `evidence` and its uniform value, both as differences of stored numbers."""
        factor = self._format.per_log_odds / LOG_ODDS_SCALE
        if factor == 1:
            return evidence.values, np.int32(evidence.uniform_value)
        values = np.empty_like(evidence.values)
        _cpu.rescale(evidence.values, np.float32(factor), values)
        return values, np.int32(round(evidence.uniform_value * factor))

    def _make_room(self, blocks: int) -> None:
        self._pool.reserve(blocks)

    def _stored_at(self, points: ArrayLike) -> NDArray[np.integer]:
        points = np.asarray(points, float).reshape(-1, 3)
        with np.errstate(invalid="ignore"):
            indices = np.floor(points / self.config.cell)
        inside = (np.abs(indices) < INDEX_LIMIT).all(axis=1)
        stored = np.full(len(points), self._format.unknown, self._format.dtype)
        found = stored[inside]
        _cpu.look_up(self.stored_cells, indices[inside].astype(np.int64), found)
        stored[inside] = found
        return stored

    def _centers_of(self, state: State) -> NDArray[np.float64]:
        indices, log_odds = self.cells()
        return self.centers(indices[self._rules.states(self._format.stored(log_odds)) == state])
