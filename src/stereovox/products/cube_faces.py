# SPDX-License-Identifier: Apache-2.0
"""The outer faces of the occupied cells as a mesh: exactly the cells, and nothing that cannot be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import State, VoxelMap
from stereovox.products.mesh import Mesh

SPAN = 1 << 21
"""Corners of cells on each axis that three of them fit into one int64."""
TRIANGLES = ((0, 1, 2), (0, 2, 3))


def cube_faces(voxel_map: VoxelMap) -> Mesh:
    """Return each face between an occupied cell and one that is not, as two triangles; equal corners are one vertex.

    Raises StereovoxError for a map that is too wide.
    """
    cells = voxel_map.cells_in(State.OCCUPIED).astype(np.int64)
    lowest = cells.min(axis=0) - 1 if len(cells) else np.zeros(3, np.int64)
    cells = cells - lowest
    if len(cells) and cells.max() + 1 >= SPAN:
        raise StereovoxError(f"a map of more than {SPAN - 2} cells in a row has no picture; crop it")
    present = np.sort(_codes(cells))
    quads = [_quads(cells, present, axis, side) for axis in range(3) for side in (0, 1)]
    corners = np.concatenate([np.zeros((0, 4, 3), np.int64), *quads])
    codes, of_corner = np.unique(_codes(corners.reshape(-1, 3)), return_inverse=True)
    faces = of_corner.reshape(-1, 4)[:, TRIANGLES].reshape(-1, 3)
    vertices = (_places(codes) + lowest) * np.array(voxel_map.config.cell)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


def _quads(cells: NDArray[np.int64], present: NDArray[np.int64], axis: int, side: int) -> NDArray[np.int64]:
    """Return the corners (n, 4, 3) of all outer faces on one side (0 below, 1 above) of an axis."""
    step = np.eye(3, dtype=np.int64)
    neighbours = _codes(cells + (2 * side - 1) * step[axis])
    at = np.searchsorted(present, neighbours).clip(max=max(len(present) - 1, 0))
    outer = cells[present[at] != neighbours] if len(present) else cells
    u, v = step[(axis + 1) % 3], step[(axis + 2) % 3]
    square = np.stack([0 * u, u, u + v, v])
    return outer[:, None] + side * step[axis] + (square if side else square[::-1])


def _codes(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number for each place (n, 3); `_places` is the inverse."""
    x, y, z = places.T
    return (x * SPAN + y) * SPAN + z


def _places(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([codes // (SPAN * SPAN), codes // SPAN % SPAN, codes % SPAN], axis=1)
