# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels with made-up frames, so that the first real one does not wait for them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Frame
from stereovox.mapper import GridMapper, Mapper
from stereovox.products.live_projection import LiveProjection
from stereovox.sources.tracker import AXES
from stereovox.track.tracker import Tracker


def warm_up(config: Config, tracked: bool = False) -> None:
    """Load or compile all kernels that depth images need under these settings; the map is discarded.

    tracked: those that tracking needs, too.
    """
    small = load_config(config, **{"window.outside": "drop"})
    camera = PinholeCamera.from_field_of_view(64, 48, 60.0)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = AXES["ros"].T
    T_world_camera[2, 3] = 1.0
    middle = (config.min_range + config.max_range) / 2
    depths = np.full((48, 64), middle, np.float32), np.full((48, 64), min(1000 * middle, 60000), np.uint16)
    frames = [
        Frame(depth, camera, T_world_camera, stamp_ns, scale)
        for stamp_ns, (depth, scale) in enumerate(zip(depths, (1.0, 0.001), strict=True))
    ]
    if config.dimensions == 2:
        floor = GridMapper(small)
        for frame in frames:
            floor.add(frame)
        floor.occupancy()
    else:
        mapper = Mapper(small)
        for frame in frames:
            mapper.add(frame)
        with suppress(StereovoxError):  # a map that is not level has no 2-D map
            LiveProjection(mapper.map).grid()
        mapper.close()
    if tracked:
        tracker = Tracker(config)
        for stamp_ns, frame in enumerate([*frames, *frames]):
            tracker.add(replace(frame, stamp_ns=stamp_ns))
