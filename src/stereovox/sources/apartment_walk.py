# SPDX-License-Identifier: Apache-2.0
"""The way of a hand-held camera through the simulated apartment: into every room, once round, out again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry import Transform, look_at, rotation_matrix

HZ = 15.0
"""Images a second: the rate at which Chien 2020 wanted to map."""
TURN_DEG = 70.0
"""Degrees a second at which the camera turns."""
EYE, PITCH_DEG = 1.35, -9.0
"""Height above the floor in metres; how far the camera looks down, in degrees, once it is on its way."""
WAYPOINTS = np.array([
    # x, y, yaw in degrees (0: east, 90: north; the camera never jumps from 180 to -180)
    [0.90, 1.60, 0],  # living room, once round clockwise
    [1.90, 1.60, -50],
    [2.30, 1.50, -140],
    [2.20, 1.60, -230],
    [2.60, 1.55, -320],
    [3.60, 1.42, -360],
    [4.66, 1.40, -360],  # passage
    [5.60, 1.50, -330],  # kitchen, once round anticlockwise
    [6.30, 1.60, -270],
    [6.40, 1.70, -180],
    [6.30, 1.60, -90],
    [6.10, 1.80, 0],
    [5.45, 2.30, 80],
    [5.43, 3.26, 90],  # door
    [5.50, 3.90, 60],
    [6.00, 3.92, 10],  # hall, east end
    [6.38, 4.10, 80],
    [6.38, 4.58, 90],  # door
    [6.60, 5.60, 60],  # study, once round clockwise
    [6.75, 5.70, -30],
    [6.70, 5.60, -120],
    [6.60, 5.50, -210],
    [6.50, 5.40, -270],
    [6.40, 5.30, -270],
    [6.38, 4.58, -270],  # backwards through the door
    [6.20, 3.95, -230],
    [5.40, 3.92, -180],
    [4.70, 4.00, -250],
    [4.63, 4.58, -270],  # door
    [4.60, 5.40, -270],  # bath, once round anticlockwise
    [4.60, 5.50, -180],
    [4.62, 5.50, -90],
    [4.60, 5.45, 0],
    [4.63, 5.30, 90],
    [4.63, 4.58, 90],  # backwards through the door
    [4.50, 3.95, 130],
    [3.80, 3.92, 180],
    [2.90, 4.00, 110],
    [2.83, 4.58, 90],  # door
    [2.70, 5.30, 100],  # bedroom, once round anticlockwise
    [2.40, 5.50, 190],
    [2.40, 5.45, 280],
    [2.45, 5.40, 370],
    [2.70, 5.30, 450],
    [2.83, 4.58, 450],  # backwards through the door
    [2.60, 3.95, 500],
    [1.70, 3.92, 540],  # hall, west end
    [1.50, 3.92, 630],
    [2.20, 3.92, 715],
    [3.50, 3.90, 700],
    [3.73, 3.80, 640],
    [3.73, 3.26, 630],  # door
    [3.60, 2.30, 600],
    [2.70, 1.60, 550],  # living room again: it sees what it has seen
    [1.60, 1.60, 630],
    [0.90, 1.60, 720],
])  # fmt: skip


def walk(speed: float) -> tuple[Callable[[float], Transform], float]:
    """Return the way (T_plan_camera at a share of it) and how many seconds it takes at `speed` m/s.

    Between waypoints the camera walks and turns at once; whatever takes longer sets the time. The first image looks
    exactly level.
    """
    from scipy.interpolate import PchipInterpolator

    times = _times(speed)
    way = PchipInterpolator(times, WAYPOINTS)  # no overshoot: it would walk into walls

    def path(share: float) -> Transform:
        seconds = share * times[-1]
        x, y, yaw_deg = way(seconds)
        return _held(np.array([x, y, EYE]), np.radians(yaw_deg), seconds)

    return path, float(times[-1])


def _times(speed: float) -> NDArray[np.float64]:
    """Return the second (N,) at which each waypoint is reached."""
    steps = np.diff(WAYPOINTS, axis=0)
    walking = np.linalg.norm(steps[:, :2], axis=1) / speed
    turning = np.abs(steps[:, 2]) / TURN_DEG
    return np.append(0.0, np.cumsum(np.maximum(walking, turning)))


def _held(eye: NDArray[np.float64], yaw: float, seconds: float) -> Transform:
    """Return T_plan_camera as a hand holds it: it bobs with the steps, sways and looks a little down."""
    beat = 2 * np.pi * seconds
    eye = eye + np.array([0, 0, 0.012 * np.sin(1.8 * beat)])
    pitch = np.radians(PITCH_DEG * (1 - np.exp(-seconds)) + 1.5 * np.sin(0.7 * beat))
    roll = np.radians(1.2 * np.sin(0.9 * beat))
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    T = look_at(eye, eye + ahead)
    T[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0, roll])
    return T
