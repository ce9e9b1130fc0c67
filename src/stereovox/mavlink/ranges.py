# SPDX-License-Identifier: Apache-2.0
"""Distances that an autopilot reports (DISTANCE_SENSOR) as `Range`, for a mapper."""

from __future__ import annotations

from math import inf, nan, radians, sqrt
from typing import Any

import numpy as np

from stereovox.cameras.lidar import RangeSensor
from stereovox.errors import FrameRefused
from stereovox.frame import Range
from stereovox.geometry.se3 import Transform, from_quaternion, rotation_matrix

TURNED_DEG = {k: 45 * k for k in range(8)}
"""Degrees to the right of ahead by MAV_SENSOR_ORIENTATION, for sensors that are level."""
UP, DOWN, CUSTOM = 24, 25, 100
"""Further orientations; the others are refused."""
UNKNOWN_VARIANCE, INVALID = 255, 1
"""`covariance` in cm^2 if it is not known, and the `signal_quality` of no reading."""
USUAL = RangeSensor()
"""Of sensors that report neither noise nor beam."""


def range_of(message: Any, T_world_body: Transform, stamp_ns: int, silence_clears: bool = False) -> Range:
    """Return a distance of an autopilot's sensor.

    Args:
        message: DISTANCE_SENSOR, as pymavlink decodes it.
        T_world_body: (4, 4) maps the body (x forward, y left, z up) into the world (z up); the sensor is at its origin.
        stamp_ns: When it was measured, in nanoseconds by the clock of the other frames.
        silence_clears: As in `RangeSensor`; a distance above the sensor's largest means that nothing was heard.

    Returns:
        The distance. The wider of both fields of view is the cone; without any it is 30 degrees.

    Raises:
        FrameRefused: `bad_form`: its limits cannot be, or it is oriented in no direction that is supported.
    """
    T = np.array(T_world_body, float)
    T[:3, :3] = T[:3, :3] @ _turned(message)
    least, most, now = (
        0.01 * number for number in (message.min_distance, message.max_distance, message.current_distance)
    )
    variance = float(message.covariance)
    sigma = USUAL.sigma if variance == UNKNOWN_VARIANCE or variance <= 0 else 0.01 * sqrt(variance)
    width = max(float(getattr(message, "horizontal_fov", 0)), float(getattr(message, "vertical_fov", 0)))
    if not 0 <= least < most:
        raise FrameRefused(
            "bad_form", f"DISTANCE_SENSOR {message.id}: limits {least:g} to {most:g} m; check its driver"
        )
    beam = RangeSensor(sigma, least, most, width if width > 0 else USUAL.beam, silence_clears)
    distance = inf if now > most else -inf if now < least else now
    if getattr(message, "signal_quality", 0) == INVALID:
        distance = nan
    return Range(distance, T, stamp_ns, beam, sensor=f"distance {message.id}")


def _turned(message: Any) -> np.ndarray:
    """Return the rotation (3, 3) of the sensor's axes (x along the cone) in the body's (x forward, y left, z up)."""
    orientation = int(message.orientation)
    if orientation in TURNED_DEG:
        return rotation_matrix([0, 0, -radians(TURNED_DEG[orientation])])
    if orientation in (UP, DOWN):
        return rotation_matrix([0, radians(-90 if orientation == UP else 90), 0])
    if orientation == CUSTOM:
        w, x, y, z = map(float, message.quaternion)
        if abs(w * w + x * x + y * y + z * z - 1) < 1e-3:
            frd = np.diag([1.0, -1.0, -1.0])
            return frd @ from_quaternion(np.zeros(3), [x, y, z, w])[:3, :3] @ frd
    raise FrameRefused("bad_form", f"DISTANCE_SENSOR {message.id}: orientation {orientation} is not supported")
