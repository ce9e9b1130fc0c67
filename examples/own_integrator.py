# SPDX-License-Identifier: Apache-2.0
"""An integrator of your own, which knows hits only, in slow NumPy."""

import numpy as np

import stereovox as sv
from stereovox.geometry.se3 import transform_points
from stereovox.integrate import INTEGRATORS
from stereovox.maps.cells.evidence import Evidence


class HitsOnly:
    """Each cell that holds a measured point becomes more probable, once a frame."""

    def __init__(self, config):
        self._voxel_size = config.voxel_size

    def evidence(self, image):
        """Return the evidence of one prepared depth image."""
        points = image.camera.back_project(image.depth_m)[np.isfinite(image.depth_m)]
        world = transform_points(image.T_world_sensor, points)
        cells = np.unique(np.floor(world / self._voxel_size).astype(np.int64), axis=0)
        blocks, of_cell = np.unique(cells >> 3, axis=0, return_inverse=True)
        values = np.zeros((len(blocks), 512), np.int16)
        x, y, z = (cells & 7).T
        values[of_cell.ravel(), 64 * x + 8 * y + z] = 847  # log(0.7 / 0.3) in thousandths
        return Evidence(blocks.astype(np.int32), values, np.empty((0, 3), np.int32), 0)


INTEGRATORS["hits"] = f"{__name__}:HitsOnly"

mapper = sv.Mapper(voxel_size=0.1, integrator="hits")
for frame in sv.open_source("sim:room", frames=":3"):
    mapper.add(frame)
print(mapper.map.counts())
