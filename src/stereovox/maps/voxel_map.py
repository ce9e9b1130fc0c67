# SPDX-License-Identifier: Apache-2.0
"""The voxel map: unbounded, sparse, fixed-point log-odds in 16 or 8 bits a cell."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.kernels.threads import Guarded
from stereovox.maps.cells.cell_format import State as State
from stereovox.maps.cells.cell_pool import NEVER
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.files.store import save_map
from stereovox.maps.query import queries
from stereovox.maps.query.queries import INDEX_LIMIT as INDEX_LIMIT
from stereovox.maps.query.queries import NearestCells, QueryTarget, RayHits
from stereovox.maps.record.kept_frames import KeptFrames
from stereovox.maps.storage.blocks import CELLS, SIDE, blocks_of_cells, span_of
from stereovox.maps.storage.storage import OnStorage, Storage


class OnBlocks(OnStorage):
    """Attributes of a voxel map kept in its storage."""

    @property
    def viewpoint(self) -> Viewpoint | None:
        """Last camera pose; None before the first frame."""
        return self.storage.viewpoint

    @viewpoint.setter
    def viewpoint(self, viewpoint: Viewpoint | None) -> None:
        self.storage.viewpoint = viewpoint

    @property
    def kept_frames(self) -> KeptFrames | None:
        """The depth images of its frames if `map.keep_frames` is set; None if it has none."""
        return self.storage.kept

    @property
    def listeners(self) -> list[Callable[[Evidence], object]]:
        """Called with the evidence after every `add`, the lock held; see `Storage`."""
        return self.storage.listeners

    @listeners.setter
    def listeners(self, listeners: list[Callable[[Evidence], object]]) -> None:
        self.storage.listeners = listeners


class VoxelMap(Guarded, OnBlocks):
    """A sparse occupancy map in the world frame (z up unless the recording says otherwise).

    Cell i covers [i, i + 1) * voxel_size on each axis, or of `config.cell` if its sides differ. A cell without
    evidence is unknown: log-odds 0, probability 0.5. With evidence it is free (p < free_below), occupied
    (p > occupied_above) or tentative between them.

    Several threads may use a map: each call holds its `lock`.

    Args:
        config: The settings.
        storage: Storage of its cells; by default in memory, without bounds.

    Attributes:
        lock: Re-entrant; hold it over several calls that must see the same state.
        storage: The stored blocks, for programs that read or write whole blocks.
    """

    storage: Storage

    def __init__(self, config: Config, *, storage: Storage | None = None):
        self.storage = Storage(config) if storage is None else storage
        self.lock = self.storage.lock

    @classmethod
    def from_cells(cls, config: Config, indices: ArrayLike, log_odds: ArrayLike) -> VoxelMap:
        """Make a map from cells. A cell named twice keeps its last value.

        Args:
            config: The settings; log-odds are clamped accordingly.
            indices: (N, 3) whole cell indices.
            log_odds: (N,); zero is stored as the smallest positive one.

        Returns:
            The map, of no frames.

        Raises:
            StereovoxError: The shapes are wrong, indices are not whole or too large, or log-odds are not numbers.
        """
        voxel_map = cls(config)
        rules, unknown = voxel_map.storage.rules, voxel_map.storage.cell_format.unknown
        indices, log_odds = _whole(_cells_of(indices)), queries.numbers_of(log_odds, "log_odds")
        if log_odds.shape not in {(), (len(indices),)}:
            raise queries.shape_error("log_odds", log_odds, f"({len(indices)},), one for each cell")
        blocks, of_cell = blocks_of_cells(indices)
        stored = np.clip(rules.format.stored(log_odds), rules.lowest, rules.highest)
        low = indices & (SIDE - 1)
        column = (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]
        cells = np.full((len(blocks), CELLS), unknown, rules.format.dtype)
        cells[of_cell, column] = np.where(stored == unknown, unknown + 1, stored)
        voxel_map.storage.insert(blocks.astype(np.int32), cells)
        return voxel_map

    def snapshot(self) -> VoxelMap:
        """Copy the map, to inspect while it changes: all cells, or those in its window.

        Returns:
            A map without bounds, with its own lock.
        """
        copy = VoxelMap(self.config)
        copy.storage.fill(self.storage, self.storage.in_memory())
        return copy

    def add(self, evidence: Evidence) -> int:
        """Add the evidence of one frame.

        Args:
            evidence: An integrator's evidence from a depth image.

        Returns:
            The number of cells whose value changed.
        """
        return self.storage.add(evidence)

    def overview(self, most: int = 4_000_000) -> VoxelMap:
        """Return a map in memory for drawing all of it: this one, or a coarser one of a large map in boxes.

        Args:
            most: Approximate number of known cells that may be loaded.

        Returns:
            The map; a cell of a coarser one has the worst state of its parts.
        """
        return self

    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Look up log-odds.

        Args:
            points: (N, 3) in metres, world frame, or (3,) for one.

        Returns:
            (N,) float32; 0 if unknown or not finite.

        Raises:
            StereovoxError: `points` is not numbers of such a shape.
        """
        return self.storage.cell_format.log_odds(self._stored_at(points))

    def probability(self, points: ArrayLike) -> NDArray[np.float32]:
        """Look up occupancy probabilities.

        Args:
            points: (N, 3) in metres, world frame, or (3,) for one.

        Returns:
            (N,) float32; 0.5 if unknown or not finite.

        Raises:
            StereovoxError: `points` is not numbers of such a shape.
        """
        return np.asarray(1 / (1 + np.exp(-self.log_odds(points))), np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Look up the `State` of cells.

        Args:
            points: (N, 3) in metres, world frame, or (3,) for one.

        Returns:
            (N,) uint8; UNKNOWN if not finite.

        Raises:
            StereovoxError: `points` is not numbers of such a shape.
        """
        return self.storage.rules.states(self._stored_at(points))

    def age(self, points: ArrayLike, now_ns: int | None = None) -> NDArray[np.float32]:
        """Return how long ago cells got their last evidence, by the stamps of the frames.

        Args:
            points: (N, 3) in metres, world frame, or (3,) for one.
            now_ns: Time in nanoseconds; None: the stamp of the last frame.

        Returns:
            (N,) float32 in seconds. NaN if the cell is unknown or was inserted without a time; negative if the
            evidence is stamped later than now.

        Raises:
            StereovoxError: The map keeps no times, or `points` is not numbers of such a shape.
        """
        points = queries.points_of(points)
        known = self.storage.stored_at(points) != self.storage.cell_format.unknown
        return self.storage.seconds_ago(np.where(known, self.storage.times_at(points), NEVER), now_ns)

    def ages(self, now_ns: int | None = None) -> NDArray[np.float32]:
        """Return the `age` of all known cells.

        Args:
            now_ns: Time in nanoseconds; None: the stamp of the last frame.

        Returns:
            (N,) float32 in seconds, in the order of `cells`.

        Raises:
            StereovoxError: The map keeps no times.
        """
        unknown = self.storage.cell_format.unknown
        found = [cells_where(coords, times, cells != unknown) for coords, cells, times in self.storage.timed()]
        indices, times = (np.concatenate(part) for part in zip(*found, strict=True))
        return self.storage.seconds_ago(times[np.lexsort(indices.T[::-1])], now_ns)

    def cast_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_distance: float,
        stop_at: Iterable[State] = (State.OCCUPIED,),
    ) -> RayHits:
        """Find where rays stop.

        A ray begins in the cell that contains its origin and inspects every cell it crosses; a cell that it only
        touches at an edge may or may not count.

        Args:
            origins: (N, 3) in metres, world frame, or (3,) for all rays.
            directions: (N, 3) of any length but zero.
            max_distance: Metres along the ray by which the cell must be entered; may be infinite.
            stop_at: States of cells that stop a ray; FREE is not allowed.

        Returns:
            Distance, cell and state where each ray stops.

        Raises:
            StereovoxError: Bad input.
        """
        return queries.cast_rays(self._asked, origins, directions, max_distance, stop_at)

    def check_boxes(self, low: ArrayLike, high: ArrayLike) -> NDArray[np.uint8]:
        """Return the worst state in boxes; worst is OCCUPIED, then TENTATIVE, UNKNOWN, FREE.

        A cell counts if it contains a point of the box, faces included: the result covers the `state` of all points
        from low to high.

        Args:
            low: (N, 3) lowest corners in metres, world frame.
            high: (N, 3) highest corners.

        Returns:
            `State` (N,) uint8.

        Raises:
            StereovoxError: Bad input.
        """
        return queries.check_boxes(self._asked, low, high)

    def check_capsules(self, start: ArrayLike, end: ArrayLike, radius: ArrayLike) -> NDArray[np.uint8]:
        """Return the worst state that capsules touch; worst is OCCUPIED, then TENTATIVE, UNKNOWN, FREE.

        A cell counts if it is no farther from the axis than the radius.

        Args:
            start: (N, 3) beginnings of the axes in metres, world frame.
            end: (N, 3) ends of the axes; the same as `start` for a ball.
            radius: Metres, (N,) or one for all.

        Returns:
            `State` (N,) uint8.

        Raises:
            StereovoxError: Bad input.
        """
        return queries.check_capsules(self._asked, start, end, radius)

    def nearest_obstacle(
        self, points: ArrayLike, max_distance: float = np.inf, obstacles: Iterable[State] = (State.OCCUPIED,)
    ) -> NearestCells:
        """Find the nearest obstacle cell.

        Args:
            points: (N, 3) in metres, world frame, or (3,) for one.
            max_distance: Metres; obstacles farther off are ignored. By default the nearest one is found however far
                it is; a limit makes the search faster if obstacles are far.
            obstacles: States of cells that are obstacles; FREE is not allowed.

        Returns:
            Distance to each nearest cell, and its indices.

        Raises:
            StereovoxError: Bad input.
        """
        return queries.nearest(self._asked, points, max_distance, obstacles)

    def cells(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return all known cells.

        Returns:
            Indices (N, 3) int32 in ascending order, and their log-odds (N,) float32.
        """
        unknown = self.storage.cell_format.unknown
        indices, stored = self._where(lambda values: values != unknown)
        return indices, self.storage.cell_format.log_odds(stored)

    def cells_in(self, state: State) -> NDArray[np.int32]:
        """Return the cells in a state other than UNKNOWN.

        Returns:
            Indices (N, 3) int32, block by block.
        """
        states = self.storage.rules.states
        found = [cells_where(coords, stored, states(stored) == state)[0] for coords, stored in self.storage.slabs()]
        return np.concatenate(found)

    def centers(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Return the centres (N, 3) in metres of cells (N, 3); raises StereovoxError for another shape."""
        return (_cells_of(indices) + 0.5) * self.config.cell

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

    def _repr_html_(self, title: str | None = None) -> str:
        """Return the notebook view: a small picture from above, and facts. title: by default the class's name."""
        from stereovox.maps.notebook import card, facts_of, voxels_from_above

        with self.lock:
            cell = self.config.cell
            sides = cell if self.config.steps else cell[:1]
            facts = facts_of(sides, self.counts(), self.bounds(), self.memory_bytes, self.history)
            blocks = self.storage.slabs()
            picture = voxels_from_above(blocks, self.storage.rules.states, cell, self.config.up, self.history)
        return card(title or type(self).__name__, facts, *picture)

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        number = np.zeros(4, np.int64)
        for _, values in self.storage.slabs():
            states = self.storage.rules.states(values)
            number += [np.count_nonzero(states == state) for state in State]
        return {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 3) in metres of all known cells; None for an empty map."""
        unknown = self.storage.cell_format.unknown
        pieces = (span_of(coords, values != unknown) for coords, values in self.storage.slabs())
        spans = [span for span in pieces if span is not None]
        if not spans:
            return None
        lowest, highest = zip(*spans, strict=True)
        return np.stack([np.min(lowest, axis=0), np.max(highest, axis=0)]) * self.config.cell

    @property
    def path(self) -> NDArray[np.float64]:
        """Positions of the camera (N, 3) in metres, world frame, in the order of the frames; several cameras one after
        another.

        Saved with the map and thinned evenly: at most 2048, 5 cm or 0.1 rad apart, farther on long paths.
        (0, 3) for a map without frames, such as an imported one.
        """
        return np.concatenate([np.empty((0, 3)), *self.history.path.lines()])

    @property
    def memory_bytes(self) -> int:
        """Bytes the map uses: stored numbers, times, block coordinates and hash."""
        return self.storage.memory_bytes

    @property
    def reserved_bytes(self) -> int:
        """Bytes allocated: in use, and room to grow (which the system provides on first use)."""
        return self.storage.reserved_bytes

    def save(self, path: str | Path) -> None:
        """Save the map; an older one there stays intact until the new one is complete.

        Args:
            path: The folder (Zarr inside).

        Raises:
            MapFileError: It cannot be written, holds something else, or is being written by another run.
        """
        save_map(self.storage, path)

    def close(self) -> None:
        """Remove what the map keeps outside memory (nothing, unless it keeps tiles on disk)."""
        self.storage.close()

    @property
    def _asked(self) -> QueryTarget:
        return QueryTarget(self.storage.stored_cells, self.storage.rules, self.config.cell)

    def _stored_at(self, points: ArrayLike) -> NDArray[np.integer]:
        return self.storage.stored_at(queries.points_of(points))

    def _centers_of(self, state: State) -> NDArray[np.float64]:
        return self.centers(self._where(lambda values: self.storage.rules.states(values) == state)[0])

    def _where(
        self, chosen: Callable[[NDArray[np.integer]], NDArray[np.bool_]]
    ) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return ascending indices (N, 3) of the cells whose stored numbers are `chosen`, and these numbers (N,)."""
        found = [cells_where(coords, values, chosen(values)) for coords, values in self.storage.slabs()]
        indices, stored = (np.concatenate(part) for part in zip(*found, strict=True))
        order = np.lexsort(indices.T[::-1])
        return indices[order], stored[order]


def unbounded(voxel_map: VoxelMap, config: Config | None = None) -> VoxelMap:
    """Return an unbounded map with all cells and their data, with the settings `config` or its own.

    Raises ConfigError if these would change the meaning of its cells.
    """
    with voxel_map.lock:
        config = config or voxel_map.config
        voxel_map.storage.check_cells(config)
        copy = VoxelMap(config)
        copy.storage.fill(voxel_map.storage, voxel_map.storage.slabs())
    return copy


def cells_where(
    coords: NDArray[np.int32], values: NDArray[np.integer], chosen: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
    """Return indices (N, 3) and stored numbers (N,) of the `chosen` cells (n, 512) of blocks (n, 3)."""
    block, column = np.nonzero(chosen)
    low = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
    return (coords[block] * SIDE + low).astype(np.int32), values[block, column]


def _cells_of(indices: ArrayLike) -> NDArray:
    """Return cell indices (N, 3); raises StereovoxError for another shape, except [] and one cell (3,)."""
    if not (isinstance(indices, np.ndarray) and indices.dtype.kind in "iu"):
        return queries.points_of(indices, "indices", wanted="(N, 3) whole numbers")
    if indices.shape in {(0,), (3,)}:
        return indices.reshape(-1, 3)
    if indices.ndim != 2 or indices.shape[1] != 3:
        raise queries.shape_error("indices", indices, "(N, 3) whole numbers")
    return indices


def _whole(cells: NDArray) -> NDArray[np.int64]:
    """Return indices (N, 3) as int64; raises StereovoxError for fractions, NaN, and cells beyond INDEX_LIMIT."""
    if cells.dtype.kind == "f" and not (np.isfinite(cells) & (cells == np.floor(cells))).all():
        raise StereovoxError("indices: give whole numbers, for example floor(points / voxel_size)")
    if cells.size and not (cells.min() >= -INDEX_LIMIT and cells.max() <= INDEX_LIMIT):
        raise StereovoxError(f"indices: from {cells.min():g} to {cells.max():g}; give at most 2^30 either way")
    return cells.astype(np.int64, copy=False)


def leaning(voxel_map: VoxelMap, points: ArrayLike, unlikely: State) -> NDArray[np.uint8]:
    """Return the states (N,) of points (N, 3), `unlikely` for tentative cells that are no likelier than the prior."""
    points = np.asarray(points, float)
    with voxel_map.lock:
        states = voxel_map.state(points)
        tentative = np.flatnonzero(states == State.TENTATIVE)
        states[tentative[voxel_map.log_odds(points[tentative]) <= voxel_map.storage.rules.prior_log_odds]] = unlikely
    return states
