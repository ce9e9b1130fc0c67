# SPDX-License-Identifier: Apache-2.0
"""What a lidar would see of a cloud, against a slow reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereovox.geometry.se3 import from_quaternion, inverse, transform_points
from stereovox.sources.bags.robot_messages import PointCloud
from stereovox.sources.robots.frames import CloudBand, scan_of_cloud

BAND = CloudBand(0.1, 1.0, 0.3, 5.0, math.radians(3))


def slow_ranges(points_base, x0: float, y0: float, yaw: float, count: int) -> list[float]:
    """Point by point, in the robot's frame."""
    found: list[list[float]] = [[] for _ in range(count)]
    for x, y, z in points_base:
        if not 0.1 <= z <= 1.0 or math.dist((x, y), (x0, y0)) < 0.3:
            continue
        turn = (math.atan2(y - y0, x - x0) - yaw + math.pi) % (2 * math.pi)
        found[round(turn / (2 * math.pi / count)) % count].append(math.dist((x, y), (x0, y0)))
    nearest = [min(beam) if beam else math.nan for beam in found]
    return [math.inf if range_m >= 5.0 else range_m for range_m in nearest]


@pytest.mark.parametrize("seed", range(4))
def test_the_same_as_the_slow_reference_for_a_tilted_sensor(seed):
    dice = np.random.default_rng(seed)
    T_base_sensor = from_quaternion([0.4, -0.2, 0.5], dice.normal(size=4))
    points = dice.normal(size=(400, 3)) * [3, 3, 0.7]
    cloud = PointCloud(7, "lidar", transform_points(inverse(T_base_sensor), points).astype(np.float32))
    scan, T_base_scan = scan_of_cloud(cloud, T_base_sensor, BAND)
    forward = T_base_sensor[:2, 0]
    yaw = math.atan2(forward[1], forward[0])
    np.testing.assert_allclose(scan.ranges, slow_ranges(points, 0.4, -0.2, yaw, 120), rtol=1e-4)
    assert np.isnan(scan.ranges).any()
    assert np.isfinite(scan.ranges).any()
    assert (scan.stamp_ns, scan.angle_min, scan.angle_step) == (7, -math.pi, pytest.approx(math.radians(3)))
    np.testing.assert_allclose(T_base_scan[:3, 3], [0.4, -0.2, 0.5])
    np.testing.assert_allclose(T_base_scan[:3, 2], [0, 0, 1])


def test_points_far_away_and_points_that_are_none():
    points = np.array([[7, 0, 0.5], [np.nan, 1, 0.5], [0, np.inf, 0.5], [0, -2, 0.5], [-0.2, 0, 0.5]], np.float32)
    scan, _ = scan_of_cloud(PointCloud(0, "", points), np.eye(4), BAND)
    assert scan.ranges[60] == np.inf  # ahead: nothing nearer than range_max
    assert scan.ranges[30] == 2  # to the right
    assert np.isnan(np.delete(scan.ranges, [30, 60])).all()


def test_an_empty_cloud_says_nothing():
    scan, _ = scan_of_cloud(PointCloud(0, "", np.empty((0, 3), np.float32)), np.eye(4), BAND)
    assert np.isnan(scan.ranges).all()
