# SPDX-License-Identifier: Apache-2.0
"""Whether a scan can be trusted, before it changes a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereovox.config import Config
from stereovox.depth.prepare import rigid_pose
from stereovox.errors import FrameRefused
from stereovox.frame import Scan


def trusted(scan: Scan, config: Config) -> Scan:
    """Return the scan with an exactly rigid pose.

    Raises FrameRefused with the reason: the source's `fault`, `bad_shape`, `bad_scan`, `pose_not_finite`,
    `pose_not_rigid`, `tilted`, `no_valid_range`.
    """
    name = scan.name or f"scan at {scan.stamp_ns} ns"
    if scan.fault:
        raise FrameRefused(scan.fault, scan.fault_detail or f"{name}: {scan.fault}")
    ranges = np.asarray(scan.ranges)
    if ranges.ndim != 1 or not ranges.size or not np.issubdtype(ranges.dtype, np.floating):
        raise FrameRefused("bad_shape", f"{name}: ranges are {ranges.shape} {ranges.dtype}; give (N,) float32 metres")
    angles, limits = (scan.angle_min, scan.angle_step), (scan.range_min, scan.range_max)
    if (
        not np.isfinite([*angles, angles[0] + angles[1] * ranges.size]).all()
        or scan.angle_step == 0
        or not (0 <= limits[0] < limits[1])
    ):
        said = f"angles from {angles[0]} by {angles[1]}, ranges from {limits[0]} to {limits[1]}"
        raise FrameRefused("bad_scan", f"{name}: {said}; steps must not be 0, and ranges must rise")
    T = rigid_pose(scan, config.pose_rigidity_tolerance)
    tilt_deg = np.degrees(np.arccos(min(abs(T[2, 2]), 1.0)))  # a sensor may hang upside down
    if tilt_deg > config.grid.max_tilt_deg:
        raise FrameRefused(
            "tilted", f"{name}: leans {tilt_deg:.1f} degrees (grid.max_tilt_deg); its beams meet the floor"
        )
    if np.isnan(ranges).all() and scan.clear is None:
        raise FrameRefused("no_valid_range", f"{name}: not one beam has a range; is the lidar covered?")
    return replace(scan, T_world_sensor=T)
