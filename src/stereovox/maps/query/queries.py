# SPDX-License-Identifier: Apache-2.0
"""Queries for planners: cells at points, rays, boxes, capsules, the nearest obstacle; one kernel call per batch.

`VoxelMap` offers them as methods.
"""

from __future__ import annotations

from collections.abc import Iterable
from operator import index
from reprlib import repr as shortened
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps.cells.cell_format import CellRules, State, Thresholds
from stereovox.maps.query import _query, _query_solids
from stereovox.maps.storage.blocks import StoredCells

INDEX_LIMIT = 2**30
"""Cell indices are in (-INDEX_LIMIT, INDEX_LIMIT); everything beyond is unknown."""
NO_CELL = -(2**31)
"""Index on all three axes if no cell was found."""
BADNESS = (State.FREE, State.UNKNOWN, State.TENTATIVE, State.OCCUPIED)
"""States from best to worst for a planner."""


class QueryTarget(NamedTuple):
    """A map as queries read it: its cells, the meaning of their numbers, and their sides in metres."""

    cells: StoredCells
    rules: CellRules
    sides: tuple[float, float, float]


class RayHits(NamedTuple):
    """The cells that stopped rays.

    distance: (N,) float32 metres from the origin to where the ray enters the cell that stops it; infinite if none
        does.
    cell: (N, 3) int32 that cell, NO_CELL if there is none.
    state: (N,) uint8 `State` of that cell, UNKNOWN if there is none.
    """

    distance: NDArray[np.float32]
    cell: NDArray[np.int32]
    state: NDArray[np.uint8]

    @classmethod
    def none(cls, number: int) -> RayHits:
        """Return `number` rays that nothing stops."""
        return cls(
            np.full(number, np.inf, np.float32), np.full((number, 3), NO_CELL, np.int32), np.zeros(number, np.uint8)
        )


class NearestCells(NamedTuple):
    """The cells nearest to points.

    distance: (N,) float32 metres to the nearest face of the cell, 0 within it; infinite if nothing is near enough.
    cell: (N, 3) int32 that cell, NO_CELL if there is none; any one of several at equal distance.
    """

    distance: NDArray[np.float32]
    cell: NDArray[np.int32]

    @classmethod
    def none(cls, number: int) -> NearestCells:
        """Return `number` points with nothing near."""
        return cls(np.full(number, np.inf, np.float32), np.full((number, 3), NO_CELL, np.int32))


def points_of(
    values: ArrayLike, name: str = "points", axes: int = 3, wanted: str = ""
) -> NDArray[np.float32] | NDArray[np.float64]:
    """Return points (N, axes), float32 if given so, else float64; one point (axes,) is a batch of one, [] is empty.

    wanted: what the caller takes, for the message. Raises StereovoxError for any other shape and for non-numbers; NaN
    and infinity are numbers.
    """
    numbers = _numbers(values, name, f"numbers of shape (N, {axes})")
    if numbers.shape not in {(0,), (axes,)} and (numbers.ndim != 2 or numbers.shape[1] != axes):
        raise shape_error(name, numbers, wanted or f"(N, {axes}) metres, or ({axes},) for one")
    numbers = numbers.reshape(-1, axes)
    return numbers if numbers.dtype == np.float32 else numbers.astype(float, copy=False)


def shape_error(name: str, given: ArrayLike, wanted: str) -> StereovoxError:
    """Return an error that names the shape and dtype of `given`, and what to give instead."""
    numbers, verb = np.asarray(given), "are" if name.endswith("s") and name != "radius" else "is"
    return StereovoxError(f"{name} {verb} {numbers.shape} {numbers.dtype}; give {wanted}")


def stored_at(
    cells: StoredCells, sides: tuple[float, float, float], points: NDArray[np.floating]
) -> NDArray[np.integer]:
    """Return the stored numbers (N,) of the cells at points, "unknown" if not finite; points as from `points_of`."""
    found = np.empty(len(points), cells.values.dtype)
    _query.look_up(cells, sides, INDEX_LIMIT, np.require(points, None, ["C", "W"]), found)
    return found


def cast_rays(
    asked: QueryTarget, origins: ArrayLike, directions: ArrayLike, max_distance: float, stop_at: Iterable[State]
) -> RayHits:
    """Return where rays stop; see `VoxelMap.cast_rays`."""
    directions = _vectors(directions, "directions")
    origins = _within_limits(asked, _vectors(origins, "origins"), "origins")
    _check_number("origins", origins, "directions", directions)
    if not directions.any(axis=1).all():
        raise StereovoxError(f"direction {np.flatnonzero(~directions.any(axis=1))[0]} is (0, 0, 0) and leads nowhere")
    n, wanted = len(directions), state_bits(stop_at, "stop_at")
    hits = RayHits.none(n)
    _query.cast(*_read(asked), wanted, asked.sides, origins, directions, distance_of(max_distance), *hits)
    return hits


def check_boxes(asked: QueryTarget, low: ArrayLike, high: ArrayLike) -> NDArray[np.uint8]:
    """Return the worst state in boxes; see `VoxelMap.check_boxes`."""
    low, high = _vectors(low, "low"), _vectors(high, "high")
    _check_number("low", low, "high", high, one_for_all=False)
    if (low > high).any():
        raise StereovoxError(f"box {np.flatnonzero((low > high).any(axis=1))[0]}: low is above high; swap them")
    levels = np.empty(len(low), np.int8)
    _query_solids.boxes(*_read(asked), _each(BADNESS[1:]), asked.sides, INDEX_LIMIT, low, high, levels)
    return _states_of(levels)


def check_capsules(asked: QueryTarget, start: ArrayLike, end: ArrayLike, radius: ArrayLike) -> NDArray[np.uint8]:
    """Return the worst state that capsules touch; see `VoxelMap.check_capsules`."""
    start, end = _within_limits(asked, _vectors(start, "start"), "start"), _vectors(end, "end")
    end = _within_limits(asked, end, "end")
    _check_number("start", start, "end", end, one_for_all=False)
    reach = _within_limits(asked, _lengths(radius, "radius"), "radius")
    _check_number("radius", reach, "start", start)
    levels = np.empty(len(start), np.int8)
    _query_solids.capsules(*_read(asked), _each(BADNESS[1:]), asked.sides, INDEX_LIMIT, start, end, reach, levels)
    return _states_of(levels)


def nearest(asked: QueryTarget, points: ArrayLike, max_distance: float, obstacles: Iterable[State]) -> NearestCells:
    """Return the cells nearest to points; see `VoxelMap.nearest_obstacle`."""
    points, wanted = _within_limits(asked, _vectors(points, "points"), "points"), state_bits(obstacles, "obstacles")
    n = len(points)
    found = NearestCells.none(n)
    _query.nearest(*_read(asked), wanted, asked.sides, points, distance_of(max_distance), *found)
    return found


def state_bits(states: Iterable[State], name: str) -> NDArray[np.uint8]:
    """Return a set of states (not FREE) as the bits (1,) of one number; raises StereovoxError for anything else."""
    try:
        wanted = {index(state) for state in ([states] if isinstance(states, int) else states)}
    except TypeError:
        wanted = set()
    if not wanted or not wanted <= set(BADNESS[1:]):
        raise StereovoxError(
            f"{name}: give one or more of State.UNKNOWN, State.TENTATIVE and State.OCCUPIED, not {_shortened(states)}"
        )
    return np.bitwise_or.reduce(_each(wanted)).reshape(1)


def _read(asked: QueryTarget) -> tuple[StoredCells, Thresholds]:
    return asked.cells, asked.rules.thresholds


def _states_of(levels: NDArray[np.int8]) -> NDArray[np.uint8]:
    return np.array(BADNESS, np.uint8)[levels + 1]


def _each(states: Iterable[int]) -> NDArray[np.uint8]:
    return np.array([1 << state for state in states], np.uint8)


def numbers_of(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return numbers of any shape; raises StereovoxError for non-numbers, including NaN."""
    numbers = _numbers(values, name, "numbers").astype(float)
    if np.isnan(numbers).any():
        raise StereovoxError(f"{name}: NaN is not a value; give numbers")
    return numbers


def _numbers(values: ArrayLike, name: str, wanted: str) -> NDArray:
    """Return whole or real numbers of any shape."""
    try:
        numbers = np.asarray(values)
    except (TypeError, ValueError):  # lists of unequal lengths
        numbers = None
    if numbers is None or numbers.dtype.kind not in "biuf":
        raise StereovoxError(f"{name}: {_shortened(values)} is not {wanted}")
    return numbers


def _shortened(values: object) -> str:
    return " ".join(shortened(values).split())


def _vectors(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return a copy as (N, 3) finite numbers."""
    vectors = np.array(points_of(values, name), float, order="C")
    if not np.isfinite(vectors).all():
        raise StereovoxError(f"{name}: number {np.flatnonzero(~np.isfinite(vectors).all(axis=1))[0]} is not finite")
    return vectors


def _lengths(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return (N,) lengths of 0 or more, infinity allowed; a single number is a batch of one."""
    lengths = np.array(_numbers(values, name, "a length in metres"), float, ndmin=1)
    if lengths.ndim != 1:
        raise shape_error(name, lengths, "(N,) metres, or one number for all")
    if not (lengths >= 0).all():
        raise StereovoxError(f"{name}: {lengths[~(lengths >= 0)][0]:g} is not a length of 0 m or more")
    return lengths


def distance_of(metres: float) -> float:
    """Return a largest distance as a number; raises StereovoxError unless it is a length of 0 m or more."""
    lengths = _lengths(metres, "max_distance")
    if len(lengths) != 1:
        raise StereovoxError(f"max_distance: {len(lengths)} lengths; give one for all")
    return float(lengths[0])


def _within_limits(asked: QueryTarget, numbers: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """Return metres (N, 3) or (N,) unchanged."""
    limit = INDEX_LIMIT * np.array(asked.sides)
    if not (np.abs(numbers) < (limit if numbers.ndim > 1 else min(limit))).all():
        raise StereovoxError(f"{name}: beyond the map, whose cells reach {min(limit) / 1000:.0f} km from its origin")
    return numbers


def _check_number(name: str, values: NDArray, other: str, others: NDArray, one_for_all: bool = True) -> None:
    if len(values) == len(others) or (one_for_all and len(values) == 1):
        return
    what = f"{'place' if values.ndim > 1 else 'length'}{'' if len(values) == 1 else 's'}"
    cure = "give one, or as many" if one_for_all else "give as many"
    raise StereovoxError(f"{name} holds {len(values)} {what}, {other} {len(others)}; {cure}")
