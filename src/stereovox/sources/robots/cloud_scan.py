# SPDX-License-Identifier: Apache-2.0
"""Convert a point cloud to the scan of a virtual 2-D lidar."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se2 import flattened, lifted
from stereovox.geometry.se3 import Transform, inverse, transform_points
from stereovox.sources.bags.robot_messages import LaserScan, PointCloud


@dataclass(frozen=True)
class CloudBand:
    """The part of a cloud that becomes a scan, in the robot's frame.

    lowest, highest: metres above the floor. range_min, range_max: metres from the sensor, seen from above; nearer
    points are the robot's own and are ignored. step: approximate width of a beam in radians.
    """

    lowest: float = 0.1
    highest: float = 1.8
    range_min: float = 0.1
    range_max: float = 20.0
    step: float = math.radians(0.5)


def scan_of_cloud(cloud: PointCloud, T_base_sensor: Transform, band: CloudBand) -> tuple[LaserScan, Transform]:
    """Return the scan of a full turn, and T_base_scan: its frame is upright at the sensor's position.

    A beam has the distance of its nearest point in the band; +inf if that is `range_max` or more; NaN if there is
    no point, since a cloud has no reason for it.
    """
    points = transform_points(T_base_sensor, cloud.points[np.isfinite(cloud.points).all(axis=1)])
    T_base_scan = lifted(flattened(T_base_sensor))
    T_base_scan[2, 3] = T_base_sensor[2, 3]
    points = points[(points[:, 2] >= band.lowest) & (points[:, 2] <= band.highest)]
    x, y, _ = transform_points(inverse(T_base_scan), points).T
    count = max(round(2 * np.pi / band.step), 1)
    step = 2 * np.pi / count
    ranges = nearest(np.hypot(x, y), np.arctan2(y, x), count, band)
    scan = LaserScan(cloud.stamp_ns, cloud.frame_id, -np.pi, step, band.range_min, band.range_max, ranges)
    return scan, T_base_scan


def nearest(
    distance: NDArray[np.float64], angle: NDArray[np.float64], count: int, band: CloudBand
) -> NDArray[np.float32]:
    """Return (count,) float32 ranges of beams that start backwards (-pi), with the nearest point of each."""
    beams = np.rint((angle + np.pi) * count / (2 * np.pi)).astype(np.int64) % count
    ranges = np.full(count, np.inf)
    far_enough = distance >= band.range_min
    np.minimum.at(ranges, beams[far_enough], distance[far_enough])
    seen = np.bincount(beams[far_enough], minlength=count) > 0
    return np.where(seen, np.where(ranges < band.range_max, ranges, np.inf), np.nan).astype(np.float32)
