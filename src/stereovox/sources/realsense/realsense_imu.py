# SPDX-License-Identifier: Apache-2.0
"""The gyroscope and accelerometer of a connected RealSense camera (D435i, D455)."""

from __future__ import annotations

from typing import Any

from stereovox.sources.imu import LiveImu
from stereovox.sources.realsense.realsense_sensor import SideSensor, ns_from_ms, transform_between

WAITING = 2000
"""Readings that may wait for the next image."""
FIRST_S, FIRST_IMAGES = 0.5, 30
"""Images wait until the IMU has run this long, to give the up direction; at most this many images."""


class MotionSensor(SideSensor):
    """Fills a `LiveImu` with the camera's motion readings.

    Args:
        rs: The library.
        sensor: The camera's motion sensor.
        profiles: Its modes by stream: `gyro` and, if available, `accel`.
        imu: The IMU to fill.
    """

    def __init__(self, rs: Any, sensor: Any, profiles: dict[str, Any], imu: LiveImu):
        super().__init__(rs, sensor, list(profiles.values()), WAITING)
        self.imu = imu

    def read(self) -> None:
        """Add the readings since the last call."""
        while self._queue is not None and (reading := self._queue.poll_for_frame()):
            data = reading.as_motion_frame().get_motion_data()
            kind = reading.get_profile().stream_type()
            add = self.imu.add_angular_rate if kind == self._rs.stream.gyro else self.imu.add_specific_force
            add(ns_from_ms(reading.get_timestamp()), (data.x, data.y, data.z))


def find_motion(rs: Any, device: Any, depth_profile: Any, name: str) -> MotionSensor | None:
    """Return the motion sensor of a camera, None if it has no gyroscope; raises RuntimeError."""
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


def _fps(profile: Any) -> float:
    return -1 if profile is None else profile.fps()
