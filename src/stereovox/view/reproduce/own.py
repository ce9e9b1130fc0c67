# SPDX-License-Identifier: Apache-2.0
"""A picture of somebody's own recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import VoxelMap
from stereovox.view.picture import draw
from stereovox.view.reproduce.shared import png


def overview_png(voxel_map: VoxelMap, way: NDArray[np.float64], heading: str) -> bytes:
    """Return a map from above, from three sides and cut open, with the camera's way (N, 3)."""
    return png(draw(voxel_map, heading=heading, trajectory=way, up=voxel_map.config.up), 70)
