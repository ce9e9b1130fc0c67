# SPDX-License-Identifier: Apache-2.0
"""Count the frames that saw each cell of the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.evaluate.cells import Keys, keys, position
from stereovox.geometry.se3 import Transform


class Sightings:
    """Counts the frames in which each cell of a set was seen.

    cells: the set, ascending keys (N,). frames: (N,) int32, number of frames that saw each.
    """

    def __init__(self, cells: Keys, voxel_size: float):
        self.cells, self.voxel_size = cells, voxel_size
        self.frames = np.zeros(len(cells), np.int32)

    def add(
        self, depth_m: NDArray[np.floating], camera: PinholeCamera, T_world_camera: Transform, max_range: float = np.inf
    ) -> None:
        """Count one frame: a cell is seen if a pixel of exact depth (height, width) up to `max_range` is in it.

        Depth is in metres along the optical axis; pixels with inf, NaN or values not above 0 do not count.
        """
        x, y = camera.ray_slopes()
        depth = np.asarray(depth_m, float)
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > 0) & (depth <= max_range), depth, np.nan)
        R, origin = T_world_camera[:3, :3] / self.voxel_size, T_world_camera[:3, 3] / self.voxel_size
        hit = np.isfinite(depth)
        landed = [
            np.floor((depth * (R[axis, 0] * x[None, :] + R[axis, 1] * y[:, None] + R[axis, 2]) + origin[axis])[hit])
            for axis in range(3)
        ]
        seen = keys(np.stack(landed, axis=1))
        seen = seen[np.diff(seen, prepend=-1) != 0]  # neighbours mostly share a cell: look up each once
        place = position(seen, self.cells)
        mask = np.zeros(len(self.cells), bool)
        mask[place[place >= 0]] = True
        self.frames += mask
