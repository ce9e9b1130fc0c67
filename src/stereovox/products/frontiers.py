# SPDX-License-Identifier: Apache-2.0
"""Frontiers: groups of free cells next to unknown ones (Yamauchi 1997), each with a place to view it from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.query.queries import points_of
from stereovox.maps.storage.blocks import CELLS
from stereovox.maps.voxel_map import cells_where
from stereovox.products.blocks import CORNERS, FACES, components, in_memory, shifted, with_margins
from stereovox.products.floor_axes import Heights, checked_band, heights_of
from stereovox.products.floor_heights import known_floor

if TYPE_CHECKING:
    from scipy.spatial import KDTree

MAX_VIEWPOINTS = 32
"""Candidate viewpoints tried per frontier."""
NOT_FREE = (State.UNKNOWN, State.TENTATIVE, State.OCCUPIED)


@dataclass(frozen=True, eq=False)
class Frontier:
    """Connected free cells next to unknown ones.

    Attributes:
        cells: (N, 3) int32, ascending.
        centroid: (3,) metres, mean of the cell centres; not always free itself.
        look_from: (3,) metres, centre of a reachable free cell with a view of the cell nearest to the centroid; None if
            there is none.
    """

    cells: NDArray[np.int32]
    centroid: NDArray[np.float64]
    look_from: NDArray[np.float64] | None


@one_state
def frontiers(
    voxel_map: VoxelMap,
    smallest: int = 10,
    longest: float = 2.0,
    heights: Heights | None = None,
    start: ArrayLike | None = None,
    radius: float = 0.25,
    floor: float | None = None,
) -> list[Frontier]:
    """Find the frontiers of a map.

    A free cell belongs to a frontier if one of the six cells at its faces is unknown. Cells that share a corner form
    one frontier, which is halved across its longest direction until it is no longer than `longest` (Zhou et al. 2021,
    FUEL, IV-A).

    Args:
        voxel_map: The map.
        smallest: Fewest cells of a frontier, before it is halved.
        longest: Largest extent in metres.
        heights: Lowest and highest metres above the floor for cell centres; None for all.
        start: (3,) metres, position of the robot; None: the camera of the last frame. The robot reaches the free cells
            connected, face by face, with the one nearest to it; without either, it is in the largest connected part.
        radius: Metres around the robot's centre that must be free.
        floor: Metres along the map's `up` of a level floor, the reference of `heights`; None: as `scan.floor`
            states, or else it is found at each place.

    Returns:
        The frontiers, largest first.

    Raises:
        StereovoxError: A value is invalid, or heights are given for a map that shows no floor.
    """
    from scipy.spatial import KDTree

    if not longest > 0:
        raise StereovoxError(f"longest {longest}: give metres above 0")
    voxel_map = in_memory(voxel_map)
    free, at_unknown = _free_cells(voxel_map)
    cells = free[at_unknown]
    if heights is not None:
        low, high = checked_band(heights)
        centres = voxel_map.centers(cells)
        above = known_floor(voxel_map, floor).at(centres, reach=np.inf)
        height = heights_of(centres, voxel_map.config.up) - above
        cells = cells[(height > low) & (height <= high)]
    reached = KDTree(_reached(voxel_map, free, start, radius))
    groups = [part for group in _groups(cells) if len(group) >= smallest for part in _parts(voxel_map, group, longest)]
    found = [_frontier(voxel_map, group, reached) for group in groups]
    return sorted(found, key=lambda frontier: -len(frontier.cells))


def write_frontiers(found: Sequence[Frontier], path: str | Path) -> None:
    """Write frontiers for `numpy.load`.

    Arrays: `cells` (N, 3) int32, `frontier` (N,) int32, the index of each cell's frontier; `centroid` (K, 3) and
    `look_from` (K, 3) in metres, NaN if missing. Raises MapFileError if the file cannot be written.
    """
    no_viewpoint = np.full(3, np.nan)
    with replacing(path) as file:
        np.savez_compressed(
            file,
            cells=np.concatenate([np.empty((0, 3), np.int32), *(one.cells for one in found)]),
            frontier=np.repeat(np.arange(len(found), dtype=np.int32), [len(one.cells) for one in found]),
            centroid=np.reshape([one.centroid for one in found], (-1, 3)),
            look_from=np.reshape([no_viewpoint if one.look_from is None else one.look_from for one in found], (-1, 3)),
        )


def _free_cells(voxel_map: VoxelMap) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return all free cells (N, 3), and which of them have an unknown cell at one of their faces."""
    rules, found = CellRules(voxel_map.config.map), []
    for coords, margins in with_margins(voxel_map):
        states = rules.states(margins)
        free = (shifted(states, (0, 0, 0)) == State.FREE).reshape(-1, CELLS)
        beside = [shifted(states, (sign * x, sign * y, sign * z)) for x, y, z in FACES for sign in (-1, 1)]
        at_unknown = np.any([states == State.UNKNOWN for states in beside], axis=0).reshape(-1, CELLS)
        found.append(cells_where(coords, at_unknown, free))
    cells, at_unknown = (np.concatenate(part) for part in zip(*found, strict=True))
    return cells, at_unknown


def _groups(cells: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Return the cells of each group, ascending."""
    cells = cells[np.lexsort(cells.T[::-1])]
    group = components(cells, CORNERS)
    order = np.argsort(group, kind="stable")
    return np.split(cells[order], np.flatnonzero(np.diff(group[order])) + 1) if len(cells) else []


def _parts(voxel_map: VoxelMap, cells: NDArray[np.int32], longest: float) -> list[NDArray[np.int32]]:
    """Return the cells in parts that are no longer than `longest`."""
    points = voxel_map.centers(cells)
    points -= points.mean(axis=0)
    along = points @ np.linalg.eigh(points.T @ points)[1][:, -1]
    if np.ptp(along) <= longest:
        return [cells]
    return [part for half in (along < 0, along >= 0) for part in _parts(voxel_map, cells[half], longest)]


def _reached(
    voxel_map: VoxelMap, cells: NDArray[np.int32], start: ArrayLike | None, radius: float
) -> NDArray[np.float64]:
    """Return the centres (N, 3) of the free cells that the robot can reach."""
    if not 0 <= radius < np.inf:
        raise StereovoxError(f"radius {radius}: give metres, 0 or more")
    here, points = _start(voxel_map, start), voxel_map.centers(cells)
    fits = voxel_map.check_capsules(points, points, radius) == State.FREE
    cells, points = cells[fits], points[fits]
    if not len(cells):
        return points
    group = components(cells, FACES)
    mine = np.bincount(group).argmax() if here is None else group[np.argmin(((points - here) ** 2).sum(axis=1))]
    return points[group == mine]


def _start(voxel_map: VoxelMap, start: ArrayLike | None) -> NDArray[np.float64] | None:
    if start is None:
        return None if voxel_map.viewpoint is None else voxel_map.viewpoint.T_world_camera[:3, 3]
    here = points_of(start, "start", wanted="(3,) metres, x y z").astype(float).ravel()
    if here.shape != (3,) or not np.isfinite(here).all():
        raise StereovoxError(f"start {start}: give a point X, Y, Z in metres")
    return here


def _frontier(voxel_map: VoxelMap, cells: NDArray[np.int32], reached: KDTree) -> Frontier:
    points = voxel_map.centers(cells)
    centroid = points.mean(axis=0)
    middle = points[np.argmin(((points - centroid) ** 2).sum(axis=1))]
    return Frontier(cells, centroid, _viewpoint(voxel_map, middle, reached))


def _viewpoint(voxel_map: VoxelMap, point: NDArray[np.float64], reached: KDTree) -> NDArray[np.float64] | None:
    """Return the nearest of MAX_VIEWPOINTS places that sees a point through free cells only."""
    if not reached.n:
        return None
    away, nearest = map(np.ravel, reached.query(point, k=min(MAX_VIEWPOINTS, reached.n)))
    for distance, place in zip(away.tolist(), reached.data[nearest], strict=True):
        if distance == 0 or np.isinf(voxel_map.cast_rays(place, point - place, distance, NOT_FREE).distance[0]):
            return place
    return None
