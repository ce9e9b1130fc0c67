# SPDX-License-Identifier: Apache-2.0
"""Evidence of depth images on cells: where their pixels end, and what they see through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.evaluate.lidar_truth import CELLS, blocks_in, view_volume
from stereovox.evaluate.truth import Keys, indices, keys, position
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import Transform, inverse, transform_points
from stereovox.maps import VoxelMap
from stereovox.maps.storage.blocks import SIDE, BlockPool

FREE, END = 1, 2
"""Marks of a cell: seen through by a frame in which no pixel ends in it; some pixel ends in it."""
SURE = 3.0
"""Log-odds of a truth's cells."""


class Seen:
    """Collects cells seen by depth images up to `max_range` metres from the camera, of `voxel_size` metres.

    margin: least distance of a seen-through cell before the end of its pixel's ray, in cells and as a share of depth.
    """

    def __init__(self, voxel_size: float, max_range: float, margin: tuple[float, float] = (0.0, 0.0)):
        self.voxel_size, self.max_range, self.margin = voxel_size, max_range, margin
        self._marks = BlockPool(np.uint8)

    def add(self, depth_m: NDArray[np.floating], camera: PinholeCamera, T_world_camera: Transform) -> None:
        """Add depths (height, width) in metres along the optical axis: 0 or NaN is no value, inf has no end."""
        depth = np.nan_to_num(np.asarray(depth_m, float), nan=0.0, posinf=np.inf)
        ends = self._ends(depth, camera, T_world_camera)
        through = self._through(depth, Viewpoint(camera, T_world_camera))
        self._mark(ends, END)
        self._mark(through[position(through, ends) < 0], FREE)

    def cells(self, wanted: int) -> Keys:
        """Return the cells, ascending, whose marks equal `wanted`: FREE, END or FREE | END."""
        n = len(self._marks)
        block, column = np.nonzero(self._marks.values[:n] == wanted)
        low = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
        return np.sort(keys(self._marks.coords[block].astype(np.int64) * SIDE + low))

    def _ends(self, depth: NDArray[np.float64], camera: PinholeCamera, T: Transform) -> Keys:
        x, y = camera.ray_slopes()
        length = depth * np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
        v, u = np.nonzero((depth > 0) & (length <= self.max_range))
        points = np.column_stack([x[u], y[v], np.ones(len(u))]) * depth[v, u, None]
        return np.unique(keys(np.floor(transform_points(T, points) / self.voxel_size)))

    def _through(self, depth: NDArray[np.float64], viewpoint: Viewpoint) -> Keys:
        """Return the cells, ascending, whose centre is well before the end of the ray through its pixel."""
        camera, T = viewpoint.camera, viewpoint.T_world_camera
        cells_off, share = self.margin
        clear = depth * (1 - share) - cells_off * self.voxel_size
        found = [np.empty(0, np.int64)]
        for blocks, inside in blocks_in(view_volume(viewpoint, self.max_range, self.voxel_size)):
            block, column = np.nonzero(inside)
            cells = blocks[block].astype(np.int64) * SIDE + np.floor(CELLS[column]).astype(np.int64)
            local = transform_points(inverse(T), (cells + 0.5) * self.voxel_size)
            near = np.square(local).sum(axis=1) <= self.max_range**2
            cells, (a, b, z) = cells[near], local[near].T
            u = np.clip(np.rint(camera.fx * a / z + camera.cx), 0, camera.width - 1).astype(int)
            v = np.clip(np.rint(camera.fy * b / z + camera.cy), 0, camera.height - 1).astype(int)
            found.append(keys(cells[z < clear[v, u]]))
        return np.sort(np.concatenate(found))

    def _mark(self, cells: Keys, mark: int) -> None:
        at = indices(cells).astype(np.int64)
        blocks, of_cell = np.unique(keys(at >> 3), return_inverse=True)
        places = self._marks.insert(indices(blocks))[of_cell]
        low = at & (SIDE - 1)
        self._marks.values[places, (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]] |= np.uint8(mark)


def truth_of(occupied: Keys, free: Keys, voxel_size: float, max_range: float) -> VoxelMap:
    """Return the truth with these cells, `SURE` either way."""
    config = load_config(voxel_size=voxel_size, max_range=max_range)
    cells = np.concatenate([indices(occupied), indices(free)])
    return VoxelMap.from_cells(config, cells, np.repeat([SURE, -SURE], [len(occupied), len(free)]))


def without(cells: Keys, *others: Keys) -> Keys:
    """Return `cells` that are in none of the `others` (ascending)."""
    for other in others:
        cells = cells[position(cells, other) < 0]
    return cells
