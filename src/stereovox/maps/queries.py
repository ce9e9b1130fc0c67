# SPDX-License-Identifier: Apache-2.0
"""What planners ask a map: cells at points, rays, boxes, capsules, the nearest obstacle; one kernel call a batch.

`VoxelMap` offers them as methods.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import _query, _query_nearest, _query_rays, _query_solids
from stereovox.maps.blocks import StoredCells
from stereovox.maps.cell_format import CellRules, State, Thresholds

INDEX_LIMIT = 2**30
"""Cell indices lie in [-INDEX_LIMIT, INDEX_LIMIT); beyond it everything is unknown."""
NO_CELL = -(2**31)
"""Stands on all three axes where no cell was found."""
BADNESS = (State.FREE, State.UNKNOWN, State.TENTATIVE, State.OCCUPIED)
"""States as a planner fears them, the best first."""


class Asked(NamedTuple):
    """A map as queries read it: its cells, what their numbers mean, and their sides in metres."""

    cells: StoredCells
    rules: CellRules
    sides: tuple[float, float, float]


class RayHits(NamedTuple):
    """Where rays stopped.

    distance: (N,) float32 metres from the origin to where the ray enters the cell that stops it; infinite where none
        does.
    cell: (N, 3) int32 this cell, NO_CELL where there is none.
    state: (N,) uint8 `State` of this cell, UNKNOWN where there is none.
    """

    distance: NDArray[np.float32]
    cell: NDArray[np.int32]
    state: NDArray[np.uint8]


class NearestCells(NamedTuple):
    """What is nearest to points.

    distance: (N,) float32 metres to the nearest face of the cell, 0 within it; infinite where nothing is near enough.
    cell: (N, 3) int32 this cell, NO_CELL where there is none; one of them where several are as near.
    """

    distance: NDArray[np.float32]
    cell: NDArray[np.int32]


def stored_at(cells: StoredCells, sides: tuple[float, float, float], points: ArrayLike) -> NDArray[np.integer]:
    """Return the stored numbers (N,) of the cells at points (N, 3) in metres, "unknown" where not finite."""
    points = np.asarray(points)
    numbers = points if points.dtype == np.float32 else points.astype(float, copy=False)
    found = np.empty(numbers.size // 3, cells.values.dtype)
    _query.look_up(cells, sides, INDEX_LIMIT, np.require(numbers.reshape(-1, 3), None, ["C", "W"]), found)
    return found


def cast_rays(
    asked: Asked, origins: ArrayLike, directions: ArrayLike, max_distance: float, stop_at: Iterable[State]
) -> RayHits:
    """Return where rays stop; see `VoxelMap.cast_rays`."""
    directions = _vectors(directions, "directions")
    origins = _within_limits(asked, _vectors(origins, "origins"), "origins")
    _check_length(origins, "origins", len(directions))
    if not directions.any(axis=1).all():
        raise StereovoxError(f"direction {np.flatnonzero(~directions.any(axis=1))[0]} is (0, 0, 0) and leads nowhere")
    n, wanted = len(directions), _bits(stop_at, "stop_at")
    hits = RayHits(np.full(n, np.inf, np.float32), np.full((n, 3), NO_CELL, np.int32), np.zeros(n, np.uint8))
    _query_rays.cast(*_read(asked), wanted, asked.sides, origins, directions, _distance(max_distance), *hits)
    return hits


def check_boxes(asked: Asked, low: ArrayLike, high: ArrayLike) -> NDArray[np.uint8]:
    """Return the worst state in boxes; see `VoxelMap.check_boxes`."""
    low, high = _vectors(low, "low"), _vectors(high, "high")
    _check_length(low, "low", len(high), least=len(high))
    if (low > high).any():
        raise StereovoxError(f"box {np.flatnonzero((low > high).any(axis=1))[0]}: low is above high; swap them")
    levels = np.empty(len(low), np.int8)
    _query_solids.boxes(*_read(asked), _each(BADNESS[1:]), asked.sides, INDEX_LIMIT, low, high, levels)
    return _states_of(levels)


def check_capsules(asked: Asked, start: ArrayLike, end: ArrayLike, radius: ArrayLike) -> NDArray[np.uint8]:
    """Return the worst state that capsules touch; see `VoxelMap.check_capsules`."""
    start, end = _within_limits(asked, _vectors(start, "start"), "start"), _vectors(end, "end")
    end = _within_limits(asked, end, "end")
    _check_length(start, "start", len(end), least=len(end))
    reach = np.array(radius, float).ravel()
    _check_length(reach, "radius", len(end))
    if not ((reach >= 0) & (reach < INDEX_LIMIT * min(asked.sides))).all():
        raise StereovoxError("radius: not a finite length of 0 m or more")
    levels = np.empty(len(start), np.int8)
    _query_solids.capsules(*_read(asked), _each(BADNESS[1:]), asked.sides, INDEX_LIMIT, start, end, reach, levels)
    return _states_of(levels)


def nearest(asked: Asked, points: ArrayLike, max_distance: float, obstacles: Iterable[State]) -> NearestCells:
    """Return what is nearest to points; see `VoxelMap.nearest_obstacle`."""
    points, wanted = _within_limits(asked, _vectors(points, "points"), "points"), _bits(obstacles, "obstacles")
    n = len(points)
    found = NearestCells(np.full(n, np.inf, np.float32), np.full((n, 3), NO_CELL, np.int32))
    _query_nearest.nearest(*_read(asked), wanted, asked.sides, points, _distance(max_distance), *found)
    return found


def _read(asked: Asked) -> tuple[StoredCells, Thresholds]:
    return asked.cells, asked.rules.thresholds


def _states_of(levels: NDArray[np.int8]) -> NDArray[np.uint8]:
    return np.array(BADNESS, np.uint8)[levels + 1]


def _each(states: Iterable[State]) -> NDArray[np.uint8]:
    return np.array([1 << state for state in states], np.uint8)


def _bits(states: Iterable[State], name: str) -> NDArray[np.uint8]:
    """Return a set of states as the bits (1,) of one number."""
    states = [states] if isinstance(states, State) else list(states)
    if not states or not set(states) <= set(BADNESS[1:]):
        raise StereovoxError(f"{name}: give one or more of State.UNKNOWN, State.TENTATIVE and State.OCCUPIED")
    return np.bitwise_or.reduce(_each(states)).reshape(1)


def _vectors(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return (N, 3) finite numbers of one's own; one vector (3,) is taken for a batch of one."""
    try:
        vectors = np.array(values, float, order="C", ndmin=2)
    except (TypeError, ValueError):
        raise StereovoxError(f"{name}: not numbers of shape (N, 3)") from None
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise StereovoxError(f"{name}: shape {np.shape(values)} is not (N, 3)")
    if not np.isfinite(vectors).all():
        raise StereovoxError(f"{name}: number {np.flatnonzero(~np.isfinite(vectors).all(axis=1))[0]} is not finite")
    return vectors


def _within_limits(asked: Asked, vectors: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    limit = INDEX_LIMIT * np.array(asked.sides)
    if not (np.abs(vectors) < limit).all():
        raise StereovoxError(f"{name}: beyond the map, whose cells reach {min(limit) / 1000:.0f} km from its origin")
    return vectors


def _check_length(values: NDArray, name: str, n: int, least: int = 1) -> None:
    if len(values) not in {least, n}:
        raise StereovoxError(f"{name}: {len(values)} for {n}; give {'as many' if least == n else 'one, or as many'}")


def _distance(metres: float) -> float:
    if not metres >= 0:
        raise StereovoxError(f"max_distance {metres} is not a length of 0 m or more")
    return float(metres)
