# SPDX-License-Identifier: Apache-2.0
"""Common parts of the sensors of a connected RealSense camera: starting, stopping, times and mounts.

The gyroscope and accelerometer of a connected RealSense camera (D435i, D455). The colour camera of a connected
RealSense, whose pictures help tracking.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from threading import Lock
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.frame import Photo
from stereovox.geometry.se3 import Transform
from stereovox.sources.imu import LiveImu
from stereovox.sources.rgbd.depth_files import Undistortion


class SideSensor:
    """A sensor next to the depth camera; tracking continues without it.

    Args:
        rs: The library.
        sensor: The sensor.
        profiles: Its modes.
        waiting: Capacity of the queue of readings.
    """

    def __init__(self, rs: Any, sensor: Any, profiles: Sequence[Any], waiting: int):
        self._rs, self._sensor, self._profiles, self._capacity = rs, sensor, list(profiles), waiting
        self._queue: Any = None

    def start(self) -> bool:
        """Start measuring; return whether it works."""
        self._queue = self._rs.frame_queue(self._capacity)
        try:
            self._sensor.open(self._profiles)
            self._sensor.start(self._queue)
        except RuntimeError:
            self.stop()
            return False
        return True

    def stop(self) -> None:
        """Stop measuring."""
        stopped(self._sensor)


def stopped(sensor: Any) -> None:
    """Stop a sensor and close it, even if it was unplugged or never started."""
    for end in (sensor.stop, sensor.close):
        with suppress(RuntimeError):
            end()


def ns_from_ms(milliseconds: float) -> int:
    """Return integer nanoseconds; a float product with 1e6 would be off by up to 128 ns for today's dates."""
    whole, rest = divmod(milliseconds, 1.0)
    return int(whole) * 1_000_000 + round(rest * 1e6)


def transform_between(one: Any, other: Any) -> Transform:
    """Return T_other_one (4, 4) of two streams from the camera's own calibration; raises RuntimeError without one."""
    T = np.eye(4)
    found = one.get_extrinsics_to(other)
    T[:3, :3] = np.reshape(found.rotation, (3, 3)).T  # librealsense stores rotations column by column
    T[:3, 3] = found.translation
    return T


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


PHOTOS_WAITING = 6
"""Number of newest pictures that are kept for tracking or recording depth images a little later."""
WITHIN_NS, PATIENCE_MS = 20_000_000, 15
"""Largest time between a picture and its depth image, and longest wait for a late picture."""
PREFERRED = (640, 480)
"""Width and height."""
GREY_FROM: dict[str, Callable[[NDArray[np.uint8]], NDArray[np.uint8]]] = {
    "yuyv": lambda data: data.reshape(*data.shape[:2], -1)[..., 0],
    "uyvy": lambda data: data.reshape(*data.shape[:2], -1)[..., 1],
    "y8": lambda data: data,
    "rgb8": lambda data: data,
    "bgr8": lambda data: data[..., ::-1],
}
"""Formats of a colour camera, the cheapest first, with a conversion of each to a grey or RGB image."""


class PhotoSensor(SideSensor):
    """Returns the picture taken with a depth image.

    Args:
        rs: The library.
        sensor: The colour camera's sensor.
        profile: Its mode.
            T_depth_photo: (4, 4), maps its optical frame into the depth camera's.

        Raises:
            RuntimeError, StereovoxError: The camera's intrinsics are missing or invalid.
    """

    def __init__(self, rs: Any, sensor: Any, profile: Any, T_depth_photo: Transform):
        super().__init__(rs, sensor, [profile], PHOTOS_WAITING)
        self._T = T_depth_photo
        lens = profile.get_intrinsics()
        self.camera = PinholeCamera(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy)
        self._undistort = Undistortion(
            self.camera, lens.coeffs
        )  # RealSense's ROS driver interprets them in the same way
        self._grey = GREY_FROM[_form(rs, profile)]
        self._waiting: deque[tuple[int, Any]] = deque(maxlen=PHOTOS_WAITING)
        self._lock = Lock()

    def stop(self) -> None:
        """Stop taking pictures, and return waiting ones to the library."""
        with self._lock:
            self._waiting.clear()
        super().stop()

    def near(self, stamp_ns: int) -> Photo:
        """Return the picture nearest to a depth image of that time; it is read when needed.

        Its `pixels` wait for 15 ms if only earlier ones have arrived; they raise FrameRefused if none is within
        20 ms, or it is no longer kept.
        """
        return Photo(cache(partial(self._pixels, stamp_ns)), self.camera, self._T)

    def _pixels(self, stamp_ns: int) -> NDArray[np.uint8]:
        with self._lock:
            return self._read(stamp_ns)

    def _read(self, stamp_ns: int) -> NDArray[np.uint8]:
        self._take(stamp_ns)
        stamp, image = min(self._waiting, key=lambda one: abs(one[0] - stamp_ns), default=(0, None))
        if image is None or abs(stamp - stamp_ns) > WITHIN_NS:
            raise FrameRefused("no_photo", f"no picture within 20 ms of the depth image at {stamp_ns}")
        size = self.camera.height, self.camera.width
        data = np.ascontiguousarray(image.get_data()).view(np.uint8).reshape(*size, -1)
        grey = self._grey(data if data.shape[2] > 1 else data[..., 0])
        return np.array(self._undistort(grey))  # a copy: the library reuses its memory

    def _take(self, stamp_ns: int) -> None:
        """Collect pictures that arrived, and wait for one that is not older than `stamp_ns`."""
        until = monotonic() + PATIENCE_MS / 1000
        while True:
            while image := self._queue.poll_for_frame():
                self._waiting.append((ns_from_ms(image.get_timestamp()), image))
            left_ms = int(1000 * (until - monotonic()))
            if left_ms <= 0 or not self._waiting or self._waiting[-1][0] >= stamp_ns:
                return
            arrived, image = self._queue.try_wait_for_frame(left_ms)
            if arrived:
                self._waiting.append((ns_from_ms(image.get_timestamp()), image))


def find_photos(rs: Any, device: Any, depth_profile: Any) -> PhotoSensor | None:
    """Return the colour camera next to a depth camera, in a mode of its rate; None if missing.

    Raises RuntimeError and StereovoxError if the camera's intrinsics or mount are unknown.
    """
    modes = [
        (sensor, profile.as_video_stream_profile())
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.color and _form(rs, profile) and profile.fps() == depth_profile.fps()
    ]
    if not modes:
        return None

    def distance(mode: tuple[Any, Any]) -> tuple[int, int]:
        size = mode[1].width(), mode[1].height()
        away = sum(abs(has - want) for has, want in zip(size, PREFERRED, strict=True))
        return away, list(GREY_FROM).index(_form(rs, mode[1]))

    sensor, profile = min(modes, key=distance)
    return PhotoSensor(rs, sensor, profile, transform_between(profile, depth_profile))


def _form(rs: Any, profile: Any) -> str:
    """Return the name of a mode's format, "" if it is not supported."""
    return next((name for name in GREY_FROM if profile.format() == getattr(rs.format, name)), "")
