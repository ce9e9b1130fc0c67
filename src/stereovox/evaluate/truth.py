# SPDX-License-Identifier: Apache-2.0
"""Exact occupancy of a scene: the cells that its surfaces touch, and those wholly inside its solids.

Cell i covers [i, i + 1) * voxel_size on each axis. Exact means the triangle-box separating axis test (Akenine-Moeller
2001), not samples on the surface.

Sets of cells as sorted int64 keys, one per cell, so that membership is a binary search.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.maps import VoxelMap
from stereovox.simulate.scene import Scene, Solid

_BITS = 21
_HALF = 1 << (_BITS - 1)

Keys = NDArray[np.int64]
"""(N,) int64, ascending and unique if it is a set."""


def occupied_cells(voxel_map: VoxelMap) -> NDArray[np.int64]:
    """Return the indices (N, 3) of all occupied cells of a map, ascending."""
    return np.floor(voxel_map.occupied() / voxel_map.voxel_size).astype(np.int64)


def keys(indices: ArrayLike) -> Keys:
    """Return one key (N,) for each cell index (N, 3) in [-2^20, 2^20); ascending keys mean ascending indices."""
    shifted = np.asarray(indices, np.int64).reshape(-1, 3) + _HALF
    return (shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2]


def indices(cell_keys: Keys) -> NDArray[np.int32]:
    """Return the cell indices (N, 3) of keys (N,)."""
    mask = (1 << _BITS) - 1
    columns = [cell_keys >> 2 * _BITS, (cell_keys >> _BITS) & mask, cell_keys & mask]
    return (np.stack(columns, axis=1) - _HALF).astype(np.int32)


def position(cell_keys: Keys, among: Keys) -> NDArray[np.int64]:
    """Return the index of each key (N,) in the ascending set `among`, -1 if it is absent."""
    if not len(among):
        return np.full(len(cell_keys), -1)
    place = np.minimum(np.searchsorted(among, cell_keys), len(among) - 1)
    return np.where(among[place] == cell_keys, place, -1)


def within(cell_keys: Keys, among: Keys, tolerance: int) -> NDArray[np.bool_]:
    """Return which cells have a cell of the set `among` within `tolerance` cells along every axis."""
    found = position(cell_keys, among) >= 0
    reach = range(-tolerance, tolerance + 1)
    for dx, dy, dz in itertools.product(reach, reach, reach):
        missing = np.flatnonzero(~found)
        step = (dx << 2 * _BITS) + (dy << _BITS) + dz
        found[missing] = position(cell_keys[missing] + step, among) >= 0
    return found


_COARSE = 16
"""The search starts with cells this many times larger and halves them."""
_OCTANTS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True, eq=False)
class Piece:
    """One solid of a scene as cells: its part, its own name, its longest axis (3,), the cells its surface touches."""

    part: str
    name: str
    axis: NDArray[np.float64]
    cells: Keys


@dataclass(frozen=True, eq=False)
class Truth:
    """Exact occupancy. `surface` and `inside` are disjoint sets of cell keys; all other cells are free.

    surface: cells that a surface touches and that are not wholly inside a solid.
    inside: cells wholly inside solids, ignored because no camera sees them.
    pieces: the solids one by one.
    """

    voxel_size: float
    surface: Keys
    inside: Keys
    pieces: tuple[Piece, ...]

    @cached_property
    def parts(self) -> list[str]:
        """Names of the parts in the order of the scene."""
        return list(dict.fromkeys(piece.part for piece in self.pieces))


def exact_occupancy(scene: Scene, voxel_size: float) -> Truth:
    """Return the exact occupancy of `scene` in cells of `voxel_size` metres."""
    touched = [keys(touched_cells(solid.triangles, voxel_size)) for solid in scene.solids]
    surface = np.unique(np.concatenate(touched))
    buried = covered(scene.solids, surface, voxel_size)
    within_solids = np.concatenate([keys(interior_cells(solid, voxel_size)) for solid in scene.solids])
    inside = np.union1d(np.setdiff1d(within_solids, surface), surface[buried])
    open_surface = surface[~buried]
    pieces = tuple(
        Piece(solid.part, solid.name, longest_axis(solid), np.intersect1d(cells, open_surface, assume_unique=True))
        for solid, cells in zip(scene.solids, touched, strict=True)
    )
    return Truth(voxel_size, open_surface, inside, pieces)


def touched_cells(triangles: NDArray[np.floating], voxel_size: float) -> NDArray[np.int32]:
    """Return the cells (M, 3), ascending and unique, that any triangle (N, 3, 3) in metres touches.

    A triangle in the face between two cells belongs to the upper one.
    """
    corners = np.asarray(triangles, float) / voxel_size
    size = _COARSE
    owner, cell = _boxes_around(corners, size)
    while True:
        keep = overlaps(corners[owner], cell.astype(float) * size, size)
        owner, cell = owner[keep], cell[keep]
        if size == 1:
            return indices(np.unique(keys(cell)))
        size //= 2
        owner, cell = np.repeat(owner, 8), (2 * cell[:, None, :] + _OCTANTS).reshape(-1, 3)


def overlaps(triangles: NDArray[np.float64], low: NDArray[np.floating], size: float) -> NDArray[np.bool_]:
    """Return, for each pair, whether triangle (N, 3, 3) and box [low, low + size), low (N, 3), share a point.

    They do not if one of 13 directions separates them: the box's axes, the triangle's normal, and the products of
    box axes and triangle edges. A triangle that merely touches a box's edge or corner counts as sharing it.
    """
    half = size / 2
    a, b, c = np.moveaxis(triangles - (low + half)[:, None, :], 1, 0)
    lowest, highest = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    hit = ((lowest < half) & (highest >= -half)).T.copy().all(axis=0)
    normal = np.cross(b - a, c - a)
    hit &= np.abs((normal * a).sum(1)) <= half * np.abs(normal).sum(1)
    for start, end, opposite in ((a, b, c), (b, c, a), (c, a, b)):
        edge = end - start
        for y, z in ((1, 2), (2, 0), (0, 1)):  # direction: box axis x edge; (0, -edge_z, edge_y) for axis x
            near = start[:, z] * edge[:, y] - start[:, y] * edge[:, z]
            far = opposite[:, z] * edge[:, y] - opposite[:, y] * edge[:, z]
            reach = half * (np.abs(edge[:, y]) + np.abs(edge[:, z]))
            hit &= (np.minimum(near, far) <= reach) & (np.maximum(near, far) >= -reach)
    return hit


def interior_cells(solid: Solid, voxel_size: float) -> NDArray[np.int32]:
    """Return the cells (M, 3) whose centre is in the solid."""
    low, high = np.floor(solid.bounds / voxel_size).astype(int)
    cells = np.stack(np.meshgrid(*map(np.arange, low, high + 1), indexing="ij"), axis=-1).reshape(-1, 3)
    return cells[solid.contains((cells + 0.5) * voxel_size)].astype(np.int32)


def covered(solids: Sequence[Solid], cell_keys: Keys, voxel_size: float) -> NDArray[np.bool_]:
    """Return which cells are wholly inside the union of solids: all eight corners and the centre are in some solid.

    Such cells contain the invisible faces between touching solids.
    """
    probes = np.concatenate([_OCTANTS, [[0.5, 0.5, 0.5]]])
    cell = indices(cell_keys)
    in_solid = np.zeros((len(cell), len(probes)), bool)
    for solid in solids:
        low, high = np.floor(solid.bounds / voxel_size)
        near = np.flatnonzero(((cell >= low) & (cell <= high)).all(axis=1))
        points = (cell[near][:, None, :] + probes) * voxel_size
        in_solid[near] |= solid.contains(points.reshape(-1, 3)).reshape(-1, len(probes))
    return np.all(in_solid, axis=1)


def longest_axis(solid: Solid) -> NDArray[np.float64]:
    """Return the unit vector (3,) along which the solid is longest."""
    corners = np.unique(solid.triangles.reshape(-1, 3).round(9), axis=0)
    return np.linalg.svd(corners - corners.mean(0), full_matrices=False)[2][0]


def _boxes_around(corners: NDArray[np.float64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs (triangle, box) of all boxes of `size` cells that the triangles' bounding boxes touch."""
    low = np.floor(corners.min(1) / size).astype(np.int64)
    counts = np.floor(corners.max(1) / size).astype(np.int64) - low + 1
    number = counts.prod(axis=1)
    owner = np.repeat(np.arange(len(corners)), number)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    ny, nz = counts[owner, 1:].T
    return owner, low[owner] + np.stack([rank // (ny * nz), rank // nz % ny, rank % nz], axis=1)
