# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels with made-up frames, so that the first real one does not wait for them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from stereovox import se2
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Frame, Scan
from stereovox.localize.amcl.localise import Localiser
from stereovox.localize.slam.line_map import cloud_of
from stereovox.localize.slam.loops import ClosureSearch
from stereovox.localize.slam.pipeline import Slam
from stereovox.mapper import GridMapper, Mapper
from stereovox.products.live_projection import LiveProjection
from stereovox.sources.tracker import AXES
from stereovox.track.tracker import Tracker


def warm_up(config: Config, tracked: bool = False, localised: bool = False) -> None:
    """Load or compile all kernels that depth images need under these settings; the map is discarded.

    tracked: those that tracking needs, too; localised: those of localisation by a lidar.
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
    if localised:
        _warm_up_localization(config)


def _warm_up_localization(config: Config) -> None:
    """Drive through a square room of 4 m: SLAM, localisation in its map, and the search for loops."""
    config, scans = load_config(config, dimensions=2), [_scan_of_room(0.1 * step) for step in range(16)]
    slam = Slam(config)
    for scan in scans:
        slam.add(scan)
    grid = slam.grid()
    if grid is None:  # no scan became part of a map: there is nothing to localise in
        return
    localiser = Localiser(grid, config, np.zeros(3))
    for scan in scans:
        localiser.add(scan)
    cloud = cloud_of(scans[0], config.slam.max_range)
    search = ClosureSearch(config.slam)
    search.set_target(cloud)
    search.match(cloud, np.zeros(3), 0.5, 0.1)
    floor = GridMapper(config)
    floor.add(scans[0])
    floor.occupancy()


def _scan_of_room(x: float) -> Scan:
    """Return what a lidar sees at `x` metres from the middle of a room of 6 by 4 m with an alcove."""
    angles = np.radians(np.arange(-120.0, 120.0))
    with np.errstate(divide="ignore"):
        across = np.where(np.cos(angles) > 0, 3.0 - x, 3.0 + x) / np.abs(np.cos(angles))
        along = np.where(np.sin(angles) > 0.3, 2.5, 2.0) / np.abs(np.sin(angles))
    ranges = np.minimum(across, along).astype(np.float32)
    step, stamp_ns = float(angles[1] - angles[0]), round(1e9 * (1 + x))
    return Scan(ranges, float(angles[0]), step, 0.02, 5.6, se2.lifted((x, 0.0, 0.0)), stamp_ns=stamp_ns)
