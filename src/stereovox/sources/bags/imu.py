# SPDX-License-Identifier: Apache-2.0
"""Which way is up by the accelerometer in a recording: at rest, and on the average, it feels what holds it up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.tf import Tf

IMU = "sensor_msgs/Imu"
SAMPLES, MIN_SAMPLES = 300, 10
"""Messages that are read, spread over the recording, and the fewest that are enough."""
GRAVITY = 9.0, 10.6
"""Length in m/s^2 that the mean acceleration must have."""


def read_acceleration(wire: Wire) -> tuple[int, str, NDArray[np.float64]]:
    """Return time in nanoseconds, frame and acceleration (3,) in m/s^2 of a `sensor_msgs/Imu`.

    Raises ValueError where it is too short, not finite, or says that it has no acceleration.
    """
    stamp_ns, frame_id = wire.header()
    *_, x, y, z, known = wire.numbers("d", 4 + 9 + 3 + 9 + 3 + 1)
    if known < 0 or not np.isfinite([x, y, z]).all():  # a first covariance of -1: not measured
        raise ValueError("tells no acceleration")
    return stamp_ns, frame_id, np.array([x, y, z])


def up_by_gravity(file: BagFile, tf: Tf, world: str) -> NDArray[np.float64] | None:
    """Return the unit vector (3,) that points up in `world`.

    None where no IMU's frame is connected with it by /tf, or the mean of the accelerations is not that of gravity.
    """
    for topic in sorted(topic for topic, kind in file.types.items() if kind == IMU):
        found = []
        count = len(file.stamps(topic))
        for i in np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).astype(int)).tolist():
            try:
                stamp_ns, frame_id, acceleration = read_acceleration(file.read(topic, i))
                found.append(tf.lookup(world, frame_id, stamp_ns)[:3, :3] @ acceleration)
            except (FrameRefused, ValueError):
                continue
        if len(found) >= MIN_SAMPLES:
            mean = np.mean(found, axis=0)
            length = float(np.linalg.norm(mean))
            if GRAVITY[0] <= length <= GRAVITY[1]:
                return mean / length
    return None
