# SPDX-License-Identifier: Apache-2.0
"""A map in another frame."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error, transform_points
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.record.camera_path import CameraPath, StampedPose
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.maps.voxel_map import INDEX_LIMIT, cells_where
from stereovox.products import _moved as _kernels
from stereovox.products.blocks import cells_at, in_memory, set_times
from stereovox.products.floor_axes import nearest_axis, upright_axes

PIECE = 512
"""Blocks processed together."""
RIGID = 1e-3
"""Largest entry of |R^T R - I| accepted as rounding."""
NEAR = 1e-6
"""Rounding tolerance, in cells, for a point on a face."""
TOUCHING = 2e-5
"""Rounding tolerance, in cells, by which touching cells may overlap."""
PARALLEL = 1e-6
"""Sine of the angle below which edges are parallel and define no separating axis."""


@one_state
def moved(voxel_map: VoxelMap, T_a_b: ArrayLike) -> VoxelMap:
    """Return a map in frame b resampled in frame a, in cells of the same size; T_a_b (4, 4) maps b into a.

    A cell gets the log-odds and the time of the cell that contains its centre. If the motion maps cells onto cells
    (whole cells, quarter turns) that is exact. If it does not, nothing occupied, tentative or unknown becomes free:

    - a cell also gets the log-odds of any occupied or tentative cell whose centre lies in it, if higher: so an occupied
    cell stays occupied, in at least one cell; - a cell that would then be free, but overlaps an occupied or tentative
    one, is tentative. The evidence for an obstacle in the cells it overlaps counts by its share of the cell; - a cell
    that would be free, but overlaps an unknown one, is unknown.

    Raises StereovoxError if T_a_b is not rigid, or moves the map too far away.
    """
    T, config = rigid(T_a_b), voxel_map.config
    if config.up_direction is not None:
        direction = T[:3, :3] @ config.up_direction
        config = config.model_copy(update={"up": nearest_axis(direction), "up_direction": tuple(direction.tolist())})
    if config.levelled_from is not None:  # no longer the world that `map --level` made
        config = config.model_copy(update={"levelled_from": None})
    return _resampled(voxel_map, T, config)


def _resampled(voxel_map: VoxelMap, T: Transform, config: Config) -> VoxelMap:
    """Return a map in frame b resampled in frame a, with the settings of the new one."""
    voxel_map = in_memory(voxel_map)
    there, blocks, pushed = VoxelMap(config), _reached(voxel_map, T), _pushed(voxel_map, T)
    for start in range(0, len(blocks), PIECE):
        coords = blocks[start : start + PIECE]
        points = transform_points(inverse(T), there.centers(_cells_of(coords)))
        cells = _stored_at(voxel_map, points).reshape(-1, CELLS)
        cells = higher(cells, cells_at(pushed, coords), there.storage.cell_format.unknown)
        _doubt(voxel_map, T, coords, cells)
        known = (cells != there.storage.cell_format.unknown).any(axis=1)
        there.storage.insert(coords[known], cells[known])
        if there.config.map.keep_times:
            times = np.maximum(voxel_map.storage.times_at(points).reshape(-1, CELLS), pushed.storage.times_of(coords))
            there.storage.set_times(coords[known], times[known], voxel_map.storage.times_start_ns)
    history = voxel_map.history.copied()
    path, loops = _moved_path(history.path, T), None if history.loops is None else history.loops.moved(T)
    there.history = replace(
        history, trusted={}, waiting={}, looks={}, doubts={}, path=path, loops=loops
    )  # poses of frame b no longer apply
    if voxel_map.viewpoint is not None:
        there.viewpoint = voxel_map.viewpoint._replace(T_world_camera=T @ voxel_map.viewpoint.T_world_camera)
    return there


def levelled(voxel_map: VoxelMap) -> VoxelMap:
    """Return a map turned so that its z axis points up if up lies between its axes; else the map itself.

    The turn is about a level axis, so directions on the floor stay as near to the map's as possible. Its settings get
    `up = "z"`. Raises StereovoxError as `moved`.
    """
    if voxel_map.config.up_direction is None:
        return voxel_map
    T = level_transform(voxel_map.config.up_direction)
    config = voxel_map.config.model_copy(update={"up": "z", "up_direction": None})
    return _resampled(voxel_map, T, config)


def level_transform(up_direction: ArrayLike) -> Transform:
    """Return the motion (4, 4), about the origin, into a world whose z axis is `up_direction` (3,), a unit vector."""
    up = np.asarray(up_direction, float)
    x = upright_axes(nearest_axis(up))[0]
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = x, np.cross(up, x), up
    return T


def rigid(T: ArrayLike) -> Transform:
    """Return a (4, 4) rigid motion with rounding removed; raises StereovoxError if it is not rigid."""
    T = np.asarray(T, float)
    error = rigidity_error(T)
    if not error <= RIGID:
        raise StereovoxError("the transform is not a rigid motion: give a 4x4 matrix, without scale or mirror")
    return orthonormalise(T)


def _moved_path(path: CameraPath, T: Transform) -> CameraPath:
    there = CameraPath(path.spacing)
    for sensor, stops in path.stops.items():
        poses = (T @ path.poses(sensor))[:, :3].reshape(-1, 12).astype(np.float32).tolist()
        there.stops[sensor] = [StampedPose(seen.stamp_ns, tuple(pose)) for seen, pose in zip(stops, poses, strict=True)]
    return there


def higher(mine: NDArray[np.integer], cells: NDArray[np.integer], unknown: int) -> NDArray[np.integer]:
    """Return the larger of two maps' cells as stored; if one is unknown, the other."""
    known = np.where(mine == unknown, cells, np.maximum(mine, cells))
    return np.where(cells == unknown, mine, known)


def _doubt(voxel_map: VoxelMap, T: Transform, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
    """Change free ones of `cells` (n, 512) of blocks (n, 3) in frame a that overlap non-free ones in frame b."""
    rules, sides, R_b_a = CellRules(voxel_map.config.map), np.array(voxel_map.config.cell), inverse(T)[:3, :3]
    corners = transform_points(inverse(T), coords * (SIDE * sides)) / sides
    low = np.floor(corners).astype(np.int32)
    axes, reach = _separating_axes(R_b_a, sides)
    arrays = R_b_a * sides / sides[:, None], axes, reach, corners - low
    turn, axes, reach, rest = (array.astype(np.float32) for array in arrays)
    _kernels.doubt(voxel_map.storage.stored_cells, rules.thresholds, rules.prior, turn, axes, reach, low, rest, cells)


def _separating_axes(
    R_b_a: NDArray[np.float64], sides: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the separating directions (n, 3) of cells of both frames, and the centre distance (n,) at which they
    separate.

    Both in cells of frame b, whose cells are 1 wide along each direction: the edges of both frames, and the normals of
    an edge of each, except for parallel edges.
    """
    normals = np.cross(np.eye(3)[:, None], R_b_a.T).reshape(9, 3)
    axes = np.concatenate([np.eye(3), R_b_a.T, normals[np.linalg.norm(normals, axis=1) > PARALLEL]]) * sides
    axes /= np.abs(axes).sum(axis=1, keepdims=True)
    widths = np.abs(axes / sides @ (R_b_a * sides)).sum(axis=1)
    return axes, (1 + widths) / 2 - TOUCHING


def _pushed(voxel_map: VoxelMap, T: Transform) -> VoxelMap:
    """Return a map of the occupied and tentative cells alone, each moved into the one cell that contains its centre."""
    rules, parts = CellRules(voxel_map.config.map), []
    for coords, cells in voxel_map.storage.slabs():
        solid = rules.states(cells) >= State.TENTATIVE
        indices, stored = cells_where(coords, cells, solid)
        times = voxel_map.storage.times_of(coords)[solid] if voxel_map.config.map.keep_times else np.zeros(len(stored))
        parts.append((indices, stored, times))
    indices, stored, times = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(stored, kind="stable")  # of several in one cell the last, the highest, wins
    places = transform_points(T, voxel_map.centers(indices[order])) / voxel_map.config.cell
    indices = np.floor(places + NEAR).astype(np.int64)
    pushed = VoxelMap.from_cells(voxel_map.config, indices, voxel_map.storage.cell_format.log_odds(stored[order]))
    if voxel_map.config.map.keep_times:
        set_times(pushed, indices, times[order].astype(np.uint32), voxel_map.storage.times_start_ns)
    return pushed


def _reached(voxel_map: VoxelMap, T: Transform) -> NDArray[np.int32]:
    """Return the blocks (n, 3) that the map's blocks may reach after the motion, each once."""
    block = SIDE * np.array(voxel_map.config.cell)
    coords = np.concatenate([coords for coords, _ in voxel_map.storage.slabs()])
    corners = np.array(list(product((0, 1), repeat=3)))
    places = transform_points(T, ((coords[:, None] + corners) * block).reshape(-1, 3)).reshape(-1, 8, 3) / block
    if np.abs(places).max(initial=0) * SIDE >= INDEX_LIMIT:
        raise StereovoxError("the transform takes the map beyond the range of cell indices; give it in metres")
    low, high = np.floor(places.min(axis=1) - NEAR).astype(np.int64), np.floor(places.max(axis=1) + NEAR).astype(int)
    most = (high - low).max(axis=0, initial=-1) + 1
    found = [(low + offset)[(low + offset <= high).all(axis=1)] for offset in np.ndindex(*most)]
    return np.unique(np.concatenate([np.empty((0, 3), np.int64), *found]), axis=0).astype(np.int32)


def _cells_of(coords: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the indices (n * 512, 3) of all cells of blocks (n, 3), in storage order."""
    return (
        coords[:, None].astype(np.int64) * SIDE + np.stack(np.unravel_index(np.arange(CELLS), (SIDE,) * 3), 1)
    ).reshape(-1, 3)


def _stored_at(voxel_map: VoxelMap, points: NDArray[np.float64]) -> NDArray[np.integer]:
    """Return the stored cells at points (N, 3); no known cell has a log-odds of exactly zero."""
    log_odds, cell_format = voxel_map.log_odds(points), voxel_map.storage.cell_format
    stored = np.where(log_odds == 0, cell_format.unknown, cell_format.stored(log_odds))
    return stored.astype(cell_format.dtype)
