# SPDX-License-Identifier: Apache-2.0
"""The voxel map: unbounded, sparse, fixed-point log-odds in 16 bits a cell."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import ConfigError
from stereovox.maps import _cpu
from stereovox.maps.blocks import SIDE, BlockPool
from stereovox.maps.evidence import LOG_ODDS_SCALE, Evidence, to_units

INDEX_LIMIT = 2**30
"""Cell indices lie in [-INDEX_LIMIT, INDEX_LIMIT); beyond it everything is unknown."""


class State(IntEnum):
    """What a map says about a cell."""

    UNKNOWN = 0
    FREE = 1
    TENTATIVE = 2
    OCCUPIED = 3


class VoxelMap:
    """A sparse occupancy map in the world frame (z up unless the recording says otherwise).

    Cell i covers [i, i + 1) * voxel_size on each axis. A cell without evidence is unknown: log-odds 0, probability
    0.5. With evidence it is free (p < free_below), occupied (p > occupied_above) or tentative between them.
    `config` holds the settings the map was made with, `frames` the number of frames that are in it, `frames_refused`
    the number that were offered and refused, `recording` the name of what they came from, if known.
    """

    def __init__(self, config: Config):
        self.config = config
        self.voxel_size = config.voxel_size
        self.frames = 0
        self.frames_refused = 0
        self.recording = ""
        self._pool = BlockPool(np.int16)
        self._at_floor = np.zeros(self._pool.coords.shape[0], np.uint8)
        self._lowest, self._highest = (
            np.int32(to_units(x)) for x in (config.map.log_odds_min, config.map.log_odds_max)
        )
        self._free_below, self._occupied_above = (
            float(np.log(p / (1 - p)) * LOG_ODDS_SCALE) for p in (config.map.free_below, config.map.occupied_above)
        )

    @classmethod
    def from_cells(cls, config: Config, indices: ArrayLike, log_odds: ArrayLike) -> VoxelMap:
        """Return a map of these cells: (N, 3) whole cell indices and (N,) log-odds, clamped as `config` says.

        A cell named twice keeps its last value; a log-odds of zero is stored as "just known" (0.001).
        """
        voxel_map = cls(config)
        indices = np.asarray(indices, np.int64).reshape(-1, 3)
        blocks, of_cell = np.unique(indices >> 3, axis=0, return_inverse=True)
        places = voxel_map._pool.insert(blocks.astype(np.int32))
        units = np.clip(to_units(np.asarray(log_odds, float)), voxel_map._lowest, voxel_map._highest)
        low = indices & (SIDE - 1)
        column = (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]
        voxel_map._pool.values[places[of_cell.ravel()], column] = np.where(units == 0, 1, units)
        voxel_map._match_flags()
        return voxel_map

    def with_config(self, config: Config) -> VoxelMap:
        """Take over the settings of a run that goes on with this map.

        Raises ConfigError when they would change what its cells mean: the voxel size or the `map` section.
        """
        for name in ("voxel_size", "map"):
            old, new = getattr(self.config, name), getattr(config, name)
            if old != new:
                raise ConfigError(f"cannot go on: the map was made with {name} {old}, now {new} is wanted")
        self.config = config
        return self

    def add(self, evidence: Evidence) -> int:
        """Add what one frame says; return the number of cells whose value changed."""
        self._pool.reserve(len(evidence.coords) + len(evidence.uniform))
        self._match_flags()
        pool = self._pool
        blocks = (pool.table, pool.coords, pool.count, pool.values, self._at_floor)
        changed = _cpu.add_values(*blocks, evidence.coords, evidence.values, self._lowest, self._highest)
        return changed + _cpu.add_constant(*blocks, evidence.uniform, np.int32(evidence.uniform_value), self._lowest)

    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the log-odds (N,) at points (N, 3) in metres, world frame; 0 where unknown or not finite."""
        return _from_units(self._units_at(points))

    def probability(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the occupancy probability (N,) at points (N, 3) in metres, world frame; 0.5 where unknown."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds(points))), np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Return the `State` (N,) uint8 at points (N, 3) in metres, world frame."""
        return self._states(self._units_at(points))

    def cells(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return all known cells: indices (N, 3) int32 in ascending order, and their log-odds (N,)."""
        coords, values = self.blocks()
        block, column = np.nonzero(values)
        low = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
        indices = (coords[block] * SIDE + low).astype(np.int32)
        order = np.lexsort(indices.T[::-1])
        return indices[order], _from_units(values[block, column][order])

    def blocks(self) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
        """Return block coordinates (n, 3) in ascending order and their cells (n, 512) in thousandths of log-odds."""
        n = len(self._pool)
        order = np.lexsort(self._pool.coords[:n].T[::-1])
        return self._pool.coords[order], self._pool.values[order]

    def centers(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of cells (N, 3)."""
        return (np.asarray(indices) + 0.5) * self.voxel_size

    def occupied(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of all occupied cells."""
        return self._centers_of(State.OCCUPIED)

    def free(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of all free cells."""
        return self._centers_of(State.FREE)

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        number = np.bincount(self._states(self._pool.values[: len(self._pool)]).ravel(), minlength=4)
        return {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 3) in metres of all known cells; None for an empty map."""
        indices, _ = self.cells()
        if not len(indices):
            return None
        return np.stack([indices.min(0), indices.max(0) + 1]) * self.voxel_size

    @property
    def memory_bytes(self) -> int:
        """Bytes the map needs in memory: cells, block coordinates and hash."""
        return self._pool.memory_bytes

    def save(self, path: str | Path) -> None:
        """Save to the folder `path` (Zarr inside); an older map there stays whole until the new one is complete."""
        from stereovox.maps.store import save_map

        save_map(self, path)

    def _match_flags(self) -> None:
        if len(self._at_floor) != self._pool.coords.shape[0]:
            flags = np.zeros(self._pool.coords.shape[0], np.uint8)
            flags[: len(self._at_floor)] = self._at_floor
            self._at_floor = flags

    def _units_at(self, points: ArrayLike) -> NDArray[np.int16]:
        points = np.asarray(points, float).reshape(-1, 3)
        with np.errstate(invalid="ignore"):
            indices = np.floor(points / self.voxel_size)
        inside = (np.abs(indices) < INDEX_LIMIT).all(axis=1)
        units = np.zeros(len(points), np.int16)
        found = np.empty(int(inside.sum()), np.int16)
        pool = self._pool
        _cpu.look_up(pool.table, pool.coords, pool.values, indices[inside].astype(np.int64), found)
        units[inside] = found
        return units

    def _states(self, units: NDArray[np.int16]) -> NDArray[np.uint8]:
        states = np.full(units.shape, State.TENTATIVE, np.uint8)
        states[units == 0] = State.UNKNOWN
        states[units < self._free_below] = State.FREE
        states[units > self._occupied_above] = State.OCCUPIED
        return states

    def _centers_of(self, state: State) -> NDArray[np.float64]:
        indices, log_odds = self.cells()
        return self.centers(indices[self._states(to_units(log_odds).astype(np.int16)) == state])


def _from_units(units: NDArray[np.int16]) -> NDArray[np.float32]:
    return units.astype(np.float32) / np.float32(LOG_ODDS_SCALE)
