# SPDX-License-Identifier: Apache-2.0
"""Common parts of the sensors of a connected RealSense camera: starting, stopping, times and mounts."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from stereovox.geometry.se3 import Transform


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
