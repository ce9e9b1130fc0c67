# SPDX-License-Identifier: Apache-2.0
"""Clouds of a lidar in a room that is a box."""

import numpy as np

import stereovox as sv
from stereovox.geometry.se3 import rotation_matrix

HALF = np.array([3.0, 2.0, 1.5])
"""Half sides of a room in metres."""


def room_points(T, directions):
    """Return where rays (N, 3) from a sensor in the room meet its walls, in the sensor's frame."""
    rays = directions @ T[:3, :3].T
    start = T[:3, 3]
    with np.errstate(divide="ignore"):
        length = np.min(np.where(rays > 0, HALF - start, -HALF - start) / rays, axis=1)
    return directions * length[:, None]


def directions_of(seed, count=4000):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


def pose(x, y=0.0, yaw=0.0):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0, 0, yaw]), [x, y, 0.1]
    return T


def room_cloud(n, count=4000, **fields):
    T = pose(0.1 * n, 0.05 * n, 0.1 * n)
    points = room_points(T, directions_of(n, count)).astype(np.float32)
    return sv.Cloud(points, T, 10**8 * n, **fields)
