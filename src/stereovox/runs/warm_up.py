# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels with made-up frames, so that the first real one does not wait for them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Cloud, Frame, Photo, Scan
from stereovox.geometry import se2
from stereovox.localize.amcl.localise import Localiser
from stereovox.localize.slam.line_map import cloud_of
from stereovox.localize.slam.loops import ClosureSearch
from stereovox.localize.slam.pipeline import Slam
from stereovox.mapper import GridMapper, Mapper
from stereovox.products.projection import LiveProjection
from stereovox.sources.poses.tracker import AXES
from stereovox.track.tracker import Tracker


def warm_up(config: Config, tracked: bool = False, localised: bool = False, clouds: bool = False) -> None:
    """Load or compile all kernels that depth images need under these settings; the map is discarded.

    tracked: also kernels for tracking, by depth and by pictures; localised: for localisation with a lidar; clouds: for
    clouds in a 3-D map.
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
        if clouds:
            mapper.add(Cloud(_wall(middle), T_world_camera, 9))
        with suppress(StereovoxError):  # a map that is not level has no 2-D map
            LiveProjection(mapper.map).grid()
        mapper.close()
    if tracked:
        eye = PinholeCamera.from_field_of_view(320, 240, 60.0)
        tracker, photo = Tracker(config), Photo(_pattern(eye), eye)
        near = np.full((48, 64), min(middle, config.min_range + 1.0), np.float32)
        walls = [*frames, *(replace(frames[0], depth=near, photo=photo) for _ in range(4))]
        for stamp_ns, frame in enumerate([*frames, *walls]):
            tracker.add(replace(frame, stamp_ns=stamp_ns))
    if localised:
        _warm_up_localization(config)


def _wall(metres: float) -> NDArray[np.float64]:
    """Return points (N, 3) of a wall ahead, enough to pass all checks of clouds."""
    across = np.linspace(-0.5, 0.5, 32) * metres
    y, z = (axis.ravel() for axis in np.meshgrid(across, across))
    return np.column_stack([np.full(y.size, metres), y, z])


def _pattern(camera: PinholeCamera) -> NDArray[np.uint8]:
    """Return a picture with many corners."""
    rows, columns = np.indices((camera.height, camera.width)) // 10
    return np.random.default_rng(0).integers(40, 200, (rows.max() + 1, columns.max() + 1), np.uint8)[rows, columns]


def _warm_up_localization(config: Config) -> None:
    """Drive through a square room of 4 m: SLAM, localisation in its map, and the search for loops."""
    config, scans = load_config(config, dimensions=2), [_scan_of_room(0.1 * step) for step in range(16)]
    slam = Slam(config)
    for scan in scans:
        slam.add(scan)
    grid = slam.grid()
    if grid is None:  # no scan was mapped: there is nothing to localise in
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
    """Return the scan of a lidar at `x` metres from the middle of a room of 6 by 4 m with an alcove."""
    angles = np.radians(np.arange(-120.0, 120.0))
    with np.errstate(divide="ignore"):
        across = np.where(np.cos(angles) > 0, 3.0 - x, 3.0 + x) / np.abs(np.cos(angles))
        along = np.where(np.sin(angles) > 0.3, 2.5, 2.0) / np.abs(np.sin(angles))
    ranges = np.minimum(across, along).astype(np.float32)
    step, stamp_ns = float(angles[1] - angles[0]), round(1e9 * (1 + x))
    return Scan(ranges, float(angles[0]), step, 0.02, 5.6, se2.lifted((x, 0.0, 0.0)), stamp_ns=stamp_ns)
