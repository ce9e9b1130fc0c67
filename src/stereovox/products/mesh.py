# SPDX-License-Identifier: Apache-2.0
"""The surface of what is occupied, as triangles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.guarded import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.blocks import SIDE
from stereovox.maps.cell_format import CellRules
from stereovox.products.side_by_side import cells_at, in_memory

GROUP = 8
"""Blocks along each side of the cubes of the map that are looked at one by one."""
LEAST = 0.05
"""Part of the way from one cell's middle to the next by which a vertex keeps away from both."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (N, 3) float32 in metres, world frame; faces (M, 3) int32, anticlockwise from outside."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


@one_state
def surface(voxel_map: VoxelMap) -> Mesh:
    """Return the closed surface about what is occupied: every occupied cell's middle is inside, every other's outside.

    Marching cubes (Lorensen and Cline 1987, by the tables of Lewiner et al. 2003): the surface stands where the
    log-odds, linear between the middles of neighbouring cells, pass `map.occupied_above`. An unknown cell counts as
    surely free, so that nothing is invented there: towards it the surface stands no farther out than the occupied
    cell's own face. A wall seen from one side has two sides all the same: it is as thick as its cells.
    Raises StereovoxError where nothing is occupied, MissingExtra without scikit-image.
    """
    voxel_map = in_memory(voxel_map)
    parts = [part for part in _parts(voxel_map) if len(part[1])]
    if not parts:
        raise StereovoxError("nothing is occupied in the map: it has no surface")
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for start, (_, faces) in zip(first[:-1], parts, strict=True)])
    _, kept, same = np.unique(_names(vertices), axis=0, return_index=True, return_inverse=True)
    metres = (vertices[kept] + 0.5) * voxel_map.config.cell
    return Mesh(metres.astype(np.float32), same.ravel()[faces].astype(np.int32))


def _parts(voxel_map: VoxelMap) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Yield vertices (n, 3) in cells, 0 in the middle of cell 0, and faces (m, 3) of each cube of blocks."""
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise MissingExtra("scikit-image", "mesh") from None
    for corner in _groups(voxel_map):
        field = _field(voxel_map, corner)
        if field.min() < 0 < field.max():
            vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
            yield vertices.astype(float) + corner * SIDE, faces.astype(np.int64)


def _groups(voxel_map: VoxelMap) -> NDArray[np.int32]:
    """Return the lowest blocks (n, 3) of all cubes of blocks that the surface may pass."""
    rules, found = CellRules(voxel_map.config.map), [np.empty((0, 3), np.int32)]
    for coords, cells in voxel_map.slabs():
        found.append(coords[(rules.states(cells) == State.OCCUPIED).any(axis=1)])
    blocks = np.concatenate(found)
    beside = np.concatenate([blocks - step for step in np.ndindex(2, 2, 2)])  # the cubes below end in its first layer
    return (np.unique(beside // GROUP, axis=0) * GROUP).astype(np.int32)


def _field(voxel_map: VoxelMap, corner: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return how far above the threshold each cell is, (n, n, n), negative below; one layer more than the cube has."""
    rules, side = CellRules(voxel_map.config.map), GROUP + 1
    coords = corner + np.argwhere(np.ones((side,) * 3)).astype(np.int32)
    cells = cells_at(voxel_map, coords)
    level = int(rules.thresholds.occupied_least) - 0.5
    span = max(float(rules.highest) - level, level - float(rules.lowest))
    field = np.where(cells == rules.format.unknown, -span, cells - level)
    field = np.sign(field) * np.maximum(np.abs(field), LEAST * span)
    whole = field.reshape(side, side, side, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5).reshape((side * SIDE,) * 3)
    return whole[(slice(0, GROUP * SIDE + 1),) * 3].astype(np.float32)


def _names(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the edge between cells' middles that each vertex stands on, (N, 3): the same whichever cube it comes from.

    Twice the place of its middle: so one that stands on no edge, of which a cube has at most one, has its own name.
    """
    whole = np.rint(vertices)
    return (np.where(np.abs(vertices - whole) < LEAST / 2, 2 * whole, 2 * np.floor(vertices) + 1)).astype(np.int64)
