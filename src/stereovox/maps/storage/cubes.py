# SPDX-License-Identifier: Apache-2.0
"""Resample maps with cells that are not cubes, for drawing and for file formats with cubes only."""

from __future__ import annotations

from itertools import product

import numpy as np

from stereovox.config import load_config
from stereovox.kernels.threads import one_state
from stereovox.maps.voxel_map import VoxelMap

TIE = 1e-6
"""A centre this near to a face, in cubes, is on it and belongs to the cell above."""


@one_state
def in_cubes(voxel_map: VoxelMap) -> VoxelMap:
    """Return the map in cubes of the smallest side of its cells; a map of cubes is returned unchanged.

    A cube has the state of the cell that contains its centre.
    """
    if voxel_map.config.steps is None:
        return voxel_map
    side = min(voxel_map.config.cell)
    ratio = np.array(voxel_map.config.cell) / side
    cells, log_odds = voxel_map.cells()
    low, high = (np.ceil((cells + n) * ratio - 0.5 - TIE).astype(np.int64) for n in (0, 1))
    indices, values = [], []
    for offset in product(*map(range, (high - low).max(axis=0, initial=0).tolist())):
        inside = (low + offset < high).all(axis=1)
        indices.append((low + offset)[inside])
        values.append(log_odds[inside])
    config = load_config(voxel_map.config, steps=None, voxel_size=side)
    empty = np.empty((0, 3), np.int64)
    cubes = VoxelMap.from_cells(config, np.concatenate([empty, *indices]), np.concatenate([[], *values]))
    cubes.history, cubes.viewpoint = voxel_map.history.copied(), voxel_map.viewpoint
    return cubes
