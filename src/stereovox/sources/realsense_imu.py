# SPDX-License-Identifier: Apache-2.0
"""The gyroscope and accelerometer of a connected RealSense camera (D435i, D455)."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from stereovox.se3 import Transform
from stereovox.sources.imu import LiveImu

WAITING = 2000
"""Readings that may wait for the next image."""
FIRST_S, FIRST_IMAGES = 0.5, 30
"""Images wait until the IMU has spoken for so long, to tell which way is up; so many at most."""


class MotionSensor:
    """Fills a `LiveImu` with what the camera's motion sensor measures.

    Args:
        rs: The library.
        sensor: The camera's motion sensor.
        profiles: Its modes by stream: `gyro` and, where there is one, `accel`.
        imu: What is filled.
    """

    def __init__(self, rs: Any, sensor: Any, profiles: dict[str, Any], imu: LiveImu):
        self.imu = imu
        self._rs, self._sensor, self._profiles = rs, sensor, profiles
        self._queue: Any = None

    def start(self) -> bool:
        """Start measuring; return whether the camera does."""
        self._queue = self._rs.frame_queue(WAITING)
        try:
            self._sensor.open(list(self._profiles.values()))
            self._sensor.start(self._queue)
        except RuntimeError:
            self.stop()
            return False
        return True

    def stop(self) -> None:
        """Stop measuring."""
        for end in (self._sensor.stop, self._sensor.close):
            with suppress(RuntimeError):  # pulled out, or never started
                end()

    def read(self) -> None:
        """Take in what was measured since."""
        while self._queue is not None and (reading := self._queue.poll_for_frame()):
            data = reading.as_motion_frame().get_motion_data()
            kind = reading.get_profile().stream_type()
            add = self.imu.add_angular_rate if kind == self._rs.stream.gyro else self.imu.add_specific_force
            add(ns_from_ms(reading.get_timestamp()), (data.x, data.y, data.z))


def find_motion(rs: Any, device: Any, depth_profile: Any, name: str) -> MotionSensor | None:
    """Return the motion sensor of a camera, None where it has no gyroscope; raises RuntimeError."""
    for sensor in device.query_sensors():
        found: dict[str, Any] = {}
        for profile in sensor.get_stream_profiles():
            for key in ("gyro", "accel"):
                if profile.stream_type() == getattr(rs.stream, key) and profile.fps() > _fps(found.get(key)):
                    found[key] = profile
        if "gyro" in found:
            return MotionSensor(
                rs, sensor, found, LiveImu(transform_between(found["gyro"], depth_profile), f"{name} IMU")
            )
    return None


def ns_from_ms(milliseconds: float) -> int:
    """Return whole nanoseconds; times 1e6 as a float, today's dates would be off by up to 128 ns."""
    whole, rest = divmod(milliseconds, 1.0)
    return int(whole) * 1_000_000 + round(rest * 1e6)


def transform_between(one: Any, other: Any) -> Transform:
    """Return T_other_one (4, 4) of two streams by the camera's own calibration; raises RuntimeError without one."""
    T = np.eye(4)
    found = one.get_extrinsics_to(other)
    T[:3, :3] = np.reshape(found.rotation, (3, 3)).T  # librealsense stores rotations column by column
    T[:3, 3] = found.translation
    return T


def _fps(profile: Any) -> float:
    return -1 if profile is None else profile.fps()
