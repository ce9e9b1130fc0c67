# SPDX-License-Identifier: Apache-2.0
"""Whether a scan can be trusted, before it changes a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereovox import geometry
from stereovox.config import Config
from stereovox.depth.form import EXACT, FARTHEST, check_form, matrix_of, rigid_pose
from stereovox.errors import FrameRefused
from stereovox.frame import Scan, name_of


def trusted(scan: Scan, config: Config) -> Scan:
    """Return the scan with an exactly rigid pose.

    Raises FrameRefused as `sound` does, or `tilted` where the sensor leans by more than `grid.max_tilt_deg`.
    """
    scan = sound(scan, config.pose_rigidity_tolerance)
    upright = abs(scan.T_world_sensor[2, 2])  # a sensor may hang upside down
    tilt_deg = np.degrees(np.arccos(min(upright, 1.0)))
    if tilt_deg > config.grid.max_tilt_deg:
        raise FrameRefused(
            "tilted", f"{name_of(scan)}: leans {tilt_deg:.1f} degrees (grid.max_tilt_deg); its beams meet the floor"
        )
    return scan


def sound(scan: Scan, rigidity: float) -> Scan:
    """Return the scan with an exactly rigid pose and mount; one off by more than `rigidity` is refused.

    Raises FrameRefused with the reason: `bad_form`, the source's `fault`, `bad_shape`, `bad_scan`, `pose_not_finite`,
    `pose_not_rigid`, `mount_not_rigid`, `no_valid_range`.
    """
    check_form(scan, Scan)
    name = name_of(scan)
    ranges = np.asarray(scan.ranges)
    if ranges.ndim != 1 or not ranges.size or not np.issubdtype(ranges.dtype, np.floating):
        raise FrameRefused("bad_shape", f"{name}: ranges are {ranges.shape} {ranges.dtype}; give (N,) float32 metres")
    angles = float(scan.angle_min), float(scan.angle_step)
    limits = float(scan.range_min), float(scan.range_max)
    if (
        not np.isfinite([*angles, angles[0] + angles[1] * ranges.size]).all()
        or scan.angle_step == 0
        or not (0 <= limits[0] < limits[1])
    ):
        said = f"angles from {angles[0]} by {angles[1]}, ranges from {limits[0]} to {limits[1]}"
        raise FrameRefused("bad_scan", f"{name}: {said}; steps must not be 0, and ranges must rise")
    T, mount = rigid_pose(scan, rigidity), _mount(scan, rigidity)
    if np.isnan(ranges).all() and scan.clear is None:
        raise FrameRefused("no_valid_range", f"{name}: not one beam has a range; is the lidar covered?")
    return replace(scan, T_world_sensor=T, T_base_sensor=mount)


def _mount(scan: Scan, rigidity: float) -> geometry.Transform:
    T = matrix_of(scan.T_base_sensor)
    error = geometry.rigidity_error(T)
    if error > rigidity or (np.abs(T) >= FARTHEST).any():
        said = "T_base_sensor, where the lidar sits on the robot, is no rigid 4x4 motion"
        raise FrameRefused("mount_not_rigid", f"{name_of(scan)}: {said} (off by {error:.2g})")
    return geometry.orthonormalise(T) if error > EXACT else T
