# SPDX-License-Identifier: Apache-2.0
"""Resample one 2-D map onto the cells of another, whatever their cell sizes, origins and rotations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry import se2
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State

MAX_CELLS = 40_000_000
"""Most cells of the rectangle around both maps: 126 m x 126 m in cells of 2 cm. Distances take 40 bytes a cell."""
EMPTY_REFERENCE = "the reference has no free and no occupied cell: there is nothing to compare with; give another"
ROWS_AT_ONCE = 256
TIE = 1e-6
"""Share of a cell by which points on the border of two cells are shifted, so that rounding does not decide."""
Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1 in metres: two opposite corners, in the reference's map frame."""


@dataclass(frozen=True, eq=False)
class AlignedGrids:
    """A map aligned with a reference: both on the cells of the reference, in the reference's map frame.

    map, reference: cover all cells known to either, at least one.
    excluded: (rows, columns) bool, cells whose centre is in an excluded region.
    motion: (3,) pose_reference_map by which the map was moved.
    """

    map: OccupancyGrid
    reference: OccupancyGrid
    excluded: NDArray[np.bool_]
    motion: se2.Pose


def aligned_grids(
    grid: OccupancyGrid, reference: OccupancyGrid, motion: ArrayLike = (0, 0, 0), exclude: Iterable[Rectangle] = ()
) -> AlignedGrids:
    """Resample `grid` on the cells of `reference`, moved by `motion`: (3,) pose_reference_map of the two map frames.

    A cell takes the value at its centre; an occupied cell of the map that contains no such centre (a coarser reference,
    a rotation) is entered at its own centre, so that no obstacle is lost. Raises StereovoxError for an invalid region,
    a reference without known cells, and maps too far apart for one image.
    """
    motion = np.asarray(motion, float)
    pose = se2.compose(se2.inverse(reference.origin), se2.compose(motion, grid.origin))
    corners = se2.transform(pose, grid.known_corners * grid.resolution)[:, ::-1] / reference.resolution
    known = np.concatenate([reference.known_corners[:, ::-1], corners])
    if not (reference.cells != UNKNOWN).any():
        raise StereovoxError(EMPTY_REFERENCE)
    first = np.floor(known.min(axis=0) + TIE).astype(int)
    rows, columns = (max(1, int(n)) for n in np.ceil(known.max(axis=0) - TIE) - first)
    _check_size(rows, columns, reference.resolution)
    offset = (first[1] * reference.resolution, first[0] * reference.resolution, 0.0)
    x, y, yaw = se2.compose(reference.origin, offset).tolist()
    target = replace(reference, cells=_window(reference.cells, first, (rows, columns)), origin=(x, y, yaw))
    pose_target_map = se2.compose(se2.inverse(offset), pose)
    source = replace(target, cells=resampled(grid, pose_target_map, target))
    source = replace(source, free_below=grid.free_below, occupied_above=grid.occupied_above)
    return AlignedGrids(source, target, excluded_cells(target, exclude), motion)


def three_states(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Return (rows, columns) uint8 of UNKNOWN, FREE and OCCUPIED; tentative cells are unknown, as in map_server."""
    states = grid.states
    states[states == State.TENTATIVE] = State.UNKNOWN
    return states


def resampled(grid: OccupancyGrid, pose_target_source: ArrayLike, target: OccupancyGrid) -> NDArray[np.int8]:
    """Resample `grid` onto the cells of `target`: (rows, columns) int8.

    pose_target_source: (3,), the lower left corner of `grid` in the frame of `target`'s.
    """
    shape = target.cells.shape
    cells, found = np.full(shape, UNKNOWN, np.int8), np.zeros(grid.cells.shape, bool)
    back = se2.inverse(pose_target_source)
    for start in range(0, shape[0], ROWS_AT_ONCE):
        rows = np.arange(start, min(start + ROWS_AT_ONCE, shape[0]))
        row, column = _landed(back, rows[:, None], np.arange(shape[1]), target.resolution, grid.resolution)
        inside = _inside(row, column, grid.cells.shape)
        row, column = row[inside], column[inside]
        cells[rows[0] : rows[-1] + 1][inside] = grid.cells[row, column]
        found[row, column] = True
    lost = np.nonzero((grid.states == State.OCCUPIED) & ~found)
    row, column = _landed(pose_target_source, lost[0], lost[1], grid.resolution, target.resolution)
    inside = _inside(row, column, shape)
    np.maximum.at(cells, (row[inside], column[inside]), grid.cells[lost][inside])
    return cells


def excluded_cells(grid: OccupancyGrid, exclude: Iterable[Rectangle]) -> NDArray[np.bool_]:
    """Return which cells (rows, columns) have their centre in one of the regions of the map frame."""
    out = np.zeros(grid.cells.shape, bool)
    rows, columns = (np.arange(n) for n in out.shape)
    for region in exclude:
        x0, y0, x1, y1 = _checked(region)
        for start in range(0, len(rows), ROWS_AT_ONCE):
            part = rows[start : start + ROWS_AT_ONCE]
            x, y = _moved(grid.origin, part[:, None], columns, grid.resolution)
            out[part] |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    return out


def _checked(region: Rectangle) -> Rectangle:
    numbers = np.asarray(region, float)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise StereovoxError(f"{region}: no region; give X0,Y0,X1,Y1 in metres, two opposite corners")
    (x0, y0), (x1, y1) = numbers.reshape(2, 2).min(axis=0), numbers.reshape(2, 2).max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def _check_size(rows: int, columns: int, resolution: float) -> None:
    if rows * columns > MAX_CELLS:
        size = f"{columns * resolution:.0f} m x {rows * resolution:.0f} m in cells of {resolution:g} m"
        raise StereovoxError(f"both maps together cover {size}: too far apart; are they in one frame? align them")


def _window(cells: NDArray[np.int8], first: NDArray[np.int_], shape: tuple[int, int]) -> NDArray[np.int8]:
    """Return `shape` cells from the row and column `first` on; unknown outside the map."""
    out = np.full(shape, UNKNOWN, np.int8)
    low = np.maximum(first, 0)
    high = np.minimum(first + shape, cells.shape)
    if (high > low).all():
        (r, c), (r1, c1) = low - first, high - first
        out[r:r1, c:c1] = cells[low[0] : high[0], low[1] : high[1]]
    return out


def _moved(
    pose: ArrayLike, rows: NDArray, columns: NDArray, side: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y of the centres of cells, moved by `pose`; rows and columns are broadcast."""
    x, y, yaw = np.asarray(pose, float)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along, up = (columns + 0.5) * side, (rows + 0.5) * side
    return x + cosine * along - sine * up, y + sine * along + cosine * up


def _landed(pose: ArrayLike, rows: NDArray, columns: NDArray, side: float, other_side: float) -> tuple[NDArray, ...]:
    """Return rows and columns of the cells of size `other_side` that contain the centres of cells."""
    x, y = _moved(pose, rows, columns, side)
    return tuple(np.floor(value / other_side + TIE).astype(np.int64) for value in (y, x))


def _inside(rows: NDArray, columns: NDArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    return (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
