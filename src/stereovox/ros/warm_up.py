# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels with an empty frame, so that the first real one does not wait for them."""

from __future__ import annotations

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.frame import Frame
from stereovox.ros.mapping import Mapping
from stereovox.sources.tracker import AXES


def warm_up(config: Config) -> None:
    """Load or compile all kernels that depth images need under these settings; the map is discarded."""
    mapping = Mapping(load_config(config, **{"window.outside": "drop"}))
    camera = PinholeCamera.from_field_of_view(64, 48, 60.0)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = AXES["ros"].T
    T_world_camera[2, 3] = 1.0
    middle = (config.min_range + config.max_range) / 2
    depths = np.full((48, 64), middle, np.float32), np.full((48, 64), min(1000 * middle, 60000), np.uint16)
    for stamp_ns, (depth, scale) in enumerate(zip(depths, (1.0, 0.001), strict=True)):
        mapping.add(Frame(depth, camera, T_world_camera, stamp_ns, scale))
    mapping.grid()
    mapping.close()
