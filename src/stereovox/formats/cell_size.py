# SPDX-License-Identifier: Apache-2.0
"""Suggest a cell size from the density and the extent of points.

A floor's map as a map in space: each of its cells becomes a column between two heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, log10
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.formats.map_server import read_map_server
from stereovox.formats.octomap import OCTOMAP
from stereovox.formats.points import check_room
from stereovox.geometry import se2
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.record.history import Imported
from stereovox.products.floor_axes import checked_heights

SAMPLE, QUERIES = 400_000, 4_000
"""Points sampled from a larger cloud, and how many of them are queried for their neighbours."""
NEIGHBOUR = 4
"""Neighbour whose distance counts: on a surface of even density it is about the spacing of the points."""
FEWEST = 10
"""Distinct points below which nothing is suggested."""
PER_CELL = 2.0
"""Cells per spacing: with fewer a surface has holes."""
MOST_ALONG = 2000
"""Cells along the longest side of the cloud."""
LARGEST = 100.0
"""Metres; the settings allow no larger cells."""
MESH_ALONG = 256
"""Cells along the longest side of a mesh, whose vertices give no cell size."""
OUTLIERS = 0.1
"""Per cent of the points at each end of an axis that its extent leaves out."""
STEPS = (1, 2, 5, 10)


class SuggestedCell(NamedTuple):
    """voxel_size: metres, 1, 2 or 5 times a power of ten. why: a short reason. spacing: metres between neighbours."""

    voxel_size: float
    why: str
    spacing: float | None = None


def suggested_cell(xyz: NDArray[np.float64]) -> SuggestedCell | None:
    """Return the cell size for finite points (N, 3) in metres; None if they are too few, or all in one place.

    Twice the typical distance of neighbouring points, so that a surface has no holes; larger if the longest side
    would have more than `MOST_ALONG` cells.
    """
    spacing = typical_spacing(xyz)
    if spacing is None:
        return None
    extent = float(extents(xyz).max())
    if extent / MOST_ALONG > PER_CELL * spacing:
        return SuggestedCell(_allowed(extent / MOST_ALONG), f"since it is {extent:.3g} m long", spacing)
    return SuggestedCell(
        _allowed(PER_CELL * spacing),
        f"since its points are about {spacing if spacing < 10 else round(spacing):.3g} m apart",
        spacing,
    )


def suggested_for_mesh(vertices: NDArray[np.float64]) -> SuggestedCell | None:
    """Return the cell size for a mesh with vertices (N, 3) in metres; None if all are in one place."""
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if not extent > 0:
        return None
    return SuggestedCell(_allowed(extent / MESH_ALONG), f"since it is {extent:.3g} m long")


def typical_spacing(xyz: NDArray[np.float64]) -> float | None:
    """Return the median distance in metres of points (N, 3) from their `NEIGHBOUR`-th neighbour; None: too few points.

    A large cloud is sampled, and the distances are scaled as on surfaces.
    """
    from scipy.spatial import KDTree

    dice = np.random.default_rng(0)
    some = xyz if len(xyz) <= SAMPLE else xyz[dice.choice(len(xyz), SAMPLE, replace=False)]
    points = np.unique(some, axis=0)
    if len(points) < FEWEST:
        return None
    asked = points if len(points) <= QUERIES else points[dice.choice(len(points), QUERIES, replace=False)]
    distances, _ = KDTree(points, balanced_tree=False, compact_nodes=False).query(asked, NEIGHBOUR + 1)
    spacing = float(np.median(distances[:, NEIGHBOUR])) * np.sqrt(len(some) / len(xyz))
    return spacing if spacing > 0 and np.isfinite(spacing) else None


def extents(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the length (3,) of points (N, 3) along each axis, without outliers."""
    low, high = np.percentile(xyz, [OUTLIERS, 100 - OUTLIERS], axis=0)
    return high - low


def _allowed(number: float) -> float:
    return min(rounded_up(number), LARGEST)


def rounded_up(number: float) -> float:
    """Return the next of 1, 2 and 5 times a power of ten that is not below a positive number."""
    power = floor(log10(number))
    steps = (float(f"{step}e{power}") for step in STEPS)
    return next(rounded for rounded in steps if rounded >= number * (1 - 1e-9))


WITHIN = (1 / 6, 1 / 2, 5 / 6)
"""Points in a cell, as shares of its side, that are looked up in the floor's map."""
MAX_CELLS = 1 << 27
WORST = (State.FREE, State.TENTATIVE, State.UNKNOWN, State.OCCUPIED)
"""States from the best to the worst."""


def read_raised_floor(path: str | Path, heights: Sequence[float] | None = None) -> VoxelMap:
    """Return the floor's map at `path` (`map_server.read_map_server`) raised from the lower to the higher of `heights`.

    Raises MapFileError: one line with the file and the problem, or that `heights` are missing.
    """
    grid = read_map_server(path)
    if heights is None:
        raise MapFileError(
            f"{path}: is the map of a floor; info, picture, eval, localize and path read it as it is, MAP.yaml copies "
            "it, and --heights 0:2 raises its walls to a map in space"
        )
    low, high = heights
    try:
        made = raised(grid, (low, high))
    except StereovoxError as error:
        raise MapFileError(f"{path}: {error}") from None
    rows, columns = grid.cells.shape
    note = f"its cells are columns from {low:g} to {high:g} m: heights that the file does not have"
    made.history.imported = Imported(
        Path(path).name, f"map_server, {columns} x {rows} cells", (note, *filter(None, [grid.note]))
    )
    return made


def raised(grid: OccupancyGrid, heights: tuple[float, float]) -> VoxelMap:
    """Return a map in which each known cell of `grid` is a column of cells from the lower to the higher of `heights`.

    If the grid is rotated, or its corner is inside a cell, a cell takes the worst state in it: occupied before
    unknown before tentative before free. Raises StereovoxError for an unknown floor or too many cells.
    """
    low, high = checked_heights(heights)
    size = grid.resolution
    layers = np.arange(np.floor(low / size + 1e-6), np.ceil(high / size - 1e-6))
    corners = se2.transform(grid.origin, grid.known_corners * size) / size
    if not len(corners):
        raise StereovoxError("it has no known cell, there is nothing to raise")
    first, last = np.floor(corners.min(axis=0) + 1e-6), np.ceil(corners.max(axis=0) - 1e-6)
    if np.prod(last - first) * len(layers) > MAX_CELLS:
        raise StereovoxError(f"more than {MAX_CELLS} cells between these heights; give lower --heights")
    columns = np.stack(np.meshgrid(*map(np.arange, first, last), indexing="ij"), axis=-1).reshape(-1, 2)
    states = _worst(grid, columns)
    config = load_config(voxel_size=size, **OCTOMAP)
    log_odds = np.zeros(len(State))
    log_odds[State.FREE], log_odds[State.OCCUPIED] = config.map.log_odds_min, config.map.log_odds_max
    known = states != State.UNKNOWN
    columns, values = columns[known], log_odds[states[known]]
    indices = np.concatenate(
        [np.repeat(columns, len(layers), axis=0), np.tile(layers, len(columns))[:, None]], axis=1
    ).astype(np.int64)
    check_room(indices)
    return VoxelMap.from_cells(config, indices, np.repeat(values, len(layers)))


def _worst(grid: OccupancyGrid, cells: NDArray[np.floating | np.integer]) -> NDArray[np.uint8]:
    """Return the worst state (N,) of the grid in cells (N, 2) of its size; unknown outside it."""
    states = np.pad(grid.states, 1, constant_values=State.UNKNOWN)
    limits = np.array(states.shape) - 1
    rank = np.argsort(WORST)
    worst = np.zeros(len(cells), np.int64)
    for x in WITHIN:
        for y in WITHIN:
            rows = np.clip(grid.indices((cells + np.array([x, y])) * grid.resolution) + 1, 0, limits)
            worst = np.maximum(worst, rank[states[rows[:, 0], rows[:, 1]]])
    return np.array(WORST, np.uint8)[worst]
