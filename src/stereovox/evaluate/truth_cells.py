# SPDX-License-Identifier: Apache-2.0
"""Truth map prepared for scoring other maps.

Thickness of the surface in a cell: line, sheet or bulk, by the surface cells around it. Count the frames that saw each
cell of the truth.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import StereovoxError
from stereovox.evaluate.metrics import known_cells
from stereovox.evaluate.truth import Keys, indices, keys, position
from stereovox.geometry.se3 import Transform
from stereovox.maps import State, VoxelMap
from stereovox.maps.storage.cubes import in_cubes

_STEPS: tuple[int, ...] = tuple((keys(np.eye(3, dtype=int)) - keys([0, 0, 0])).tolist())
"""Difference of keys by one cell along x, y and z."""
_FARTHEST_BLOCK = 1 << 17
"""Keys cannot represent blocks beyond this."""
MAX_TOLERANCE = 20
_LEAST_REACH = 2
"""Cells around a surface that are always read, whatever the tolerance."""
_ROUNDING = 1e-6
"""Log-odds are stored in steps of about a thousandth: closer to a threshold counts as equal to it."""


class CellReader:
    """Reads the log-odds of a fixed set of cells from any kind of map.

    cells: the set, ascending keys (N,).
    """

    def __init__(self, cells: Keys):
        self.cells = cells
        cell = indices(cells)
        low = cell & 7
        self._blocks, of_cell = np.unique(keys(cell >> 3), return_inverse=True)
        self._place = (of_cell << 9) | (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]

    def log_odds(self, voxel_map: VoxelMap) -> NDArray[np.float32]:
        """Return the log-odds (N,) of the cells in the order of their keys; exactly 0 if unobserved."""
        return voxel_map.storage.cell_format.log_odds(self.stored(voxel_map))

    def stored(self, voxel_map: VoxelMap) -> NDArray[np.integer]:
        """Return the cells (N,) in the order of their keys, as the map stores them."""
        kind = voxel_map.storage.cell_format
        stored = np.full((len(self._blocks), 512), kind.unknown, kind.dtype)
        for coords, values in voxel_map.storage.slabs():
            row = position(keys(coords), self._blocks)
            here = (row >= 0) & (np.abs(coords) < _FARTHEST_BLOCK).all(axis=1)
            stored[row[here]] = values[here]
        return stored.ravel()[self._place]


class Neighbourhood:
    """All cells within `reach` cells, along every axis, of a fixed set of cells.

    cells: the set, ascending keys (S,); around: all cells within reach, including the set, ascending keys (D,).
    """

    def __init__(self, cells: Keys, reach: int):
        self.cells, self.around, self.reach = cells, cells, reach
        self._tables: list[NDArray[np.int64]] = []
        steps = np.arange(-reach, reach + 1)
        for step in _STEPS:  # axis by axis: three short tables instead of one of (2 reach + 1)^3
            near = self.around[:, None] + step * steps
            self.around = np.unique(near)
            self._tables.append(np.searchsorted(self.around, near))

    def within(self, tolerance: int) -> NDArray[np.bool_]:
        """Return which cells of `around` (D,) are within `tolerance` cells, at most the reach, of the set."""
        inside = np.ones(len(self.cells), bool)
        for table in self._tables:
            near = self._columns(table, tolerance)[inside]
            inside = np.zeros(table.max(initial=-1) + 1, bool)
            inside[near] = True
        return inside

    def highest(self, values: NDArray[Any], tolerance: int | None = None) -> NDArray[Any]:
        """Return for each cell (S,) the highest of the `values` (D,) within `tolerance` cells; None: within reach."""
        for table in reversed(self._tables):
            values = values[self._columns(table, self.reach if tolerance is None else tolerance)].max(axis=1)
        return values

    def spread(self, tolerance: int) -> NDArray[np.float64]:
        """Return the covariance (S, 3, 3), in cells squared, of the set's cells within `tolerance` of each."""
        inside = position(self.around, self.cells) >= 0
        steps = np.arange(-tolerance, tolerance + 1.0)
        sums: dict[tuple[int, ...], NDArray[np.float64]] = {(): inside.astype(float)}
        for axis in (2, 1, 0):  # sums of 1, of each offset and of each product of two, axis by axis
            table = self._columns(self._tables[axis], tolerance)
            more = [(axes, n) for axes in sums for n in range(3 - len(axes))]
            sums = {(*[axis] * n, *axes): sums[axes][table] @ steps**n for axes, n in more}
        count = sums[()]
        mean = np.stack([sums[(axis,)] for axis in range(3)], axis=1) / count[:, None]
        square = [[sums[min(i, j), max(i, j)] / count for j in range(3)] for i in range(3)]
        return np.moveaxis(np.array(square), -1, 0) - mean[:, :, None] * mean[:, None, :]

    def _columns(self, table: NDArray[np.int64], tolerance: int) -> NDArray[np.int64]:
        return table[:, self.reach - tolerance : self.reach + tolerance + 1]


@dataclass(frozen=True, eq=False)
class Reading:
    """Values of a map in the cells of the truth and around its surfaces.

    log_odds: (N,) float32 of each cell of the truth, 0 if unobserved; states: (N,) uint8, the `State` that the map
    itself gives each. around, around_states: the same (D,) of all cells near a surface. neighbourhood: these cells;
    surface: the indices in it of the S truly occupied cells that count. tolerance: of the truth.
    """

    log_odds: NDArray[np.float32]
    states: NDArray[np.uint8]
    around: NDArray[np.float32]
    around_states: NDArray[np.uint8]
    neighbourhood: Neighbourhood
    surface: NDArray[np.int64]
    tolerance: int

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Cells (N,) that the map has observed."""
        return self.log_odds != 0

    @property
    def probability(self) -> NDArray[np.float64]:
        """Probability (N,) that each cell is occupied, 0.5 if unobserved."""
        return 1 / (1 + np.exp(-self.log_odds.astype(float)))

    @cached_property
    def best(self) -> NDArray[np.float32]:
        """For each truly occupied cell (S,) the highest log-odds within the tolerance, -inf if all are unobserved."""
        return self.best_within(self.tolerance)

    def best_within(self, tolerance: int) -> NDArray[np.float32]:
        """Return the same within `tolerance` cells, at most the reach of the truth."""
        known = np.where(self.around == 0, np.float32(-np.inf), self.around)
        return self.neighbourhood.highest(known, tolerance)[self.surface]

    @cached_property
    def beside(self) -> NDArray[np.uint8]:
        """For each truly occupied cell (S,) the highest `State` within one cell."""
        return self.neighbourhood.highest(self.around_states, 1)[self.surface]

    @cached_property
    def reached(self) -> NDArray[np.uint8]:
        """For each truly occupied cell (S,) the highest `State` within the tolerance."""
        return self.neighbourhood.highest(self.around_states, self.tolerance)[self.surface]

    def marked(self, threshold: float) -> NDArray[np.bool_]:
        """Cells (N,) the map calls occupied, p > threshold (Valenti 2018, Eq 8.1); never an unobserved one."""
        return (self.log_odds > level(threshold)) & self.observed

    def found(self, threshold: float) -> NDArray[np.bool_]:
        """Truly occupied cells (S,) that have a cell with p > threshold within the tolerance."""
        return self.best > level(threshold)


class TruthCells:
    """The relevant cells of a truth map, and the cells within `tolerance` cells of its surfaces.

    truth_map: its occupied cells have a surface, its free cells were in view and have none; all others, including
    tentative ones, are ignored. map: the same in cubes. cells: ascending keys (N,) of the relevant ones; occupied: (N,)
    those with a surface; near: (N,) those with a surface within the tolerance; neighbourhood: the cells around the
    occupied ones; counted: (S,) those of its cells in `occupied`: all, except in a `part`. Distances count along
    each axis: diagonal neighbours are one cell away. Raises StereovoxError for a truth without such cells and an
    invalid tolerance.
    """

    def __init__(self, truth_map: VoxelMap, tolerance: int = 1):
        truth_map = in_cubes(truth_map)
        if not 0 <= tolerance <= MAX_TOLERANCE:
            raise StereovoxError(f"tolerance {tolerance} is out of range; give 0 to {MAX_TOLERANCE} cells")
        known, state = known_cells(truth_map)
        counts = (state == State.OCCUPIED) | (state == State.FREE)
        if not counts.any():
            raise StereovoxError("the truth holds no occupied and no free cell; make it with stereovox truth")
        self.map, self.tolerance = truth_map, tolerance
        self.voxel_size, self.up = truth_map.voxel_size, truth_map.config.up
        self.cells: Keys = known[counts]
        self.occupied: NDArray[np.bool_] = state[counts] == State.OCCUPIED
        self.neighbourhood = Neighbourhood(self.cells[self.occupied], max(tolerance, _LEAST_REACH))
        self.near: NDArray[np.bool_] = self.near_within(tolerance)
        around = self.neighbourhood.around
        self._reader = CellReader(np.union1d(self.cells, around))
        self._own = np.searchsorted(self._reader.cells, self.cells)
        self._around = np.searchsorted(self._reader.cells, around)
        self.counted = np.arange(len(self.neighbourhood.cells))

    def part(self, chosen: NDArray[np.bool_]) -> TruthCells:
        """Return the truth of the `chosen` cells (N,) alone; cells near them count as near, chosen or not.

        Raises StereovoxError if none is chosen.
        """
        if not chosen.any():
            raise StereovoxError("no cell of the truth lies in this part of it; choose a larger one")
        part = copy(self)
        part.cells, part.occupied, part.near = self.cells[chosen], self.occupied[chosen], self.near[chosen]
        part._own, part.counted = self._own[chosen], self.counted[chosen[self.occupied]]
        return part

    def near_within(self, tolerance: int) -> NDArray[np.bool_]:
        """Return which cells (N,) have a surface within `tolerance` cells: at most 2, or the truth's own if larger."""
        around = self.neighbourhood.around[self.neighbourhood.within(tolerance)]
        return position(self.cells, around) >= 0

    def read(self, voxel_map: VoxelMap) -> Reading:
        """Read `voxel_map`. Raises StereovoxError if its cell size differs from the truth's."""
        voxel_map = in_cubes(voxel_map)
        if not np.allclose(voxel_map.voxel_size, self.voxel_size, rtol=1e-5, atol=0):
            raise StereovoxError(
                f"cells of {voxel_map.voxel_size:g} m cannot be compared with a truth of {self.voxel_size:g} m; "
                "make both with the same --voxel-size"
            )
        stored = self._reader.stored(voxel_map)
        log_odds = voxel_map.storage.cell_format.log_odds(stored)
        states = voxel_map.storage.rules.states(stored)
        own, around = self._own, self._around
        near = log_odds[around], states[around]
        return Reading(log_odds[own], states[own], *near, self.neighbourhood, self.counted, self.tolerance)

    def surface(self) -> NDArray[np.int32]:
        """Return the indices (S, 3) of the truly occupied cells."""
        return indices(self.cells[self.occupied])

    def centers(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) of the cells in metres, world frame."""
        return np.asarray((indices(self.cells) + 0.5) * self.voxel_size, float)


def level(threshold: float) -> float:
    """Return the log-odds that a cell must exceed to have p > threshold. Raises StereovoxError outside (0, 1)."""
    if not 0 < threshold < 1:
        raise StereovoxError(
            f"threshold {threshold} is not a probability between 0 and 1; leave it out for the map's own"
        )
    return log(threshold / (1 - threshold)) + _ROUNDING


WINDOW = 2
"""Cells inspected to each side."""
THIN = 2.5
"""Extent in cells below which a shape counts as one or two cells thick."""


class Thickness(IntEnum):
    """Shape of the surface cells around a cell.

    LINE: one or two cells across in two directions, like poles, wires, table legs and lone cells. SHEET: in one
    direction, like walls and floors, with their edges and corners. BULK: in none, where surfaces meet.
    """

    LINE = 0
    SHEET = 1
    BULK = 2


def thickness(surface: Neighbourhood) -> NDArray[np.uint8]:
    """Return the `Thickness` (S,) uint8 of each surface cell.

    It uses the surface cells in the cube of 5 cells a side around it, in any orientation: a row of w cells has
    the variance (w^2 - 1) / 12, so that sqrt(12 v + 1) is the extent in cells along a principal axis of variance v.
    """
    variances = np.linalg.eigvalsh(surface.spread(WINDOW))  # (S, 3), ascending
    extents = np.sqrt(12 * np.maximum(variances, 0) + 1)
    return (extents >= THIN)[:, :2].sum(axis=1).astype(np.uint8)


class Sightings:
    """Counts the frames in which each cell of a set was seen.

    cells: the set, ascending keys (N,). frames: (N,) int32, number of frames that saw each.
    """

    def __init__(self, cells: Keys, voxel_size: float):
        self.cells, self.voxel_size = cells, voxel_size
        self.frames = np.zeros(len(cells), np.int32)

    def add(
        self, depth_m: NDArray[np.floating], camera: PinholeCamera, T_world_camera: Transform, max_range: float = np.inf
    ) -> None:
        """Count one frame: a cell is seen if a pixel of exact depth (height, width) up to `max_range` is in it.

        Depth is in metres along the optical axis; pixels with inf, NaN or values not above 0 do not count.
        """
        x, y = camera.ray_slopes()
        depth = np.asarray(depth_m, float)
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > 0) & (depth <= max_range), depth, np.nan)
        R, origin = T_world_camera[:3, :3] / self.voxel_size, T_world_camera[:3, 3] / self.voxel_size
        hit = np.isfinite(depth)
        landed = [
            np.floor((depth * (R[axis, 0] * x[None, :] + R[axis, 1] * y[:, None] + R[axis, 2]) + origin[axis])[hit])
            for axis in range(3)
        ]
        seen = keys(np.stack(landed, axis=1))
        seen = seen[np.diff(seen, prepend=-1) != 0]  # neighbours mostly share a cell: look up each once
        place = position(seen, self.cells)
        mask = np.zeros(len(self.cells), bool)
        mask[place[place >= 0]] = True
        self.frames += mask
