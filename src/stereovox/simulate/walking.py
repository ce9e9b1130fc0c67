# SPDX-License-Identifier: Apache-2.0
"""A person walks from waypoint to waypoint with a camera in the hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, look_at, rotation_matrix

TURN_DEG = 70.0
"""Degrees a second at which the camera turns."""
EYE, PITCH_DEG = 1.35, -9.0
"""Height above the floor in metres; downward pitch of the camera in degrees while walking."""


def walk(
    waypoints: NDArray[np.float64], speed: float, turn_deg: float = TURN_DEG
) -> tuple[Callable[[float], Transform], float]:
    """Return the path (T_world_camera at a share of it) and its duration in seconds at `speed` m/s.

    waypoints: (N, 3) x and y in metres and yaw in degrees (0: along x, 90: along y; never a jump from 180 to -180).
    Between two of them the camera walks and turns (`turn_deg` a second) at once; the slower of both sets the time,
    and it never leaves the rectangle between them. Floor at z = 0. The first image is exactly level.
    """
    from scipy.interpolate import PchipInterpolator

    times = _times(waypoints, speed, turn_deg)
    way = PchipInterpolator(times, waypoints)  # no overshoot: it would walk into walls

    def path(share: float) -> Transform:
        seconds = share * times[-1]
        x, y, yaw_deg = way(seconds)
        return _held(np.array([x, y, EYE]), np.radians(yaw_deg), seconds)

    return path, float(times[-1])


def _times(waypoints: NDArray[np.float64], speed: float, turn_deg: float) -> NDArray[np.float64]:
    """Return the second (N,) at which each waypoint is reached."""
    steps = np.diff(waypoints, axis=0)
    walking = np.linalg.norm(steps[:, :2], axis=1) / speed
    turning = np.abs(steps[:, 2]) / turn_deg
    return np.append(0.0, np.cumsum(np.maximum(walking, turning)))


def _held(eye: NDArray[np.float64], yaw: float, seconds: float) -> Transform:
    """Return T_world_camera of a hand-held camera: it bobs with the steps, sways and tilts slightly down."""
    beat = 2 * np.pi * seconds
    eye = eye + np.array([0, 0, 0.012 * np.sin(1.8 * beat)])
    pitch = np.radians(PITCH_DEG * (1 - np.exp(-seconds)) + 1.5 * np.sin(0.7 * beat))
    roll = np.radians(1.2 * np.sin(0.9 * beat))
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    T = look_at(eye, eye + ahead)
    T[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0, roll])
    return T
