# SPDX-License-Identifier: Apache-2.0
"""Inertial measurement units in bags, and the up direction from them: at rest, and on average, an accelerometer
measures the force that supports it."""

from __future__ import annotations

import os
import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.geometry.se3 import Transform
from stereovox.sources.bags.depth_topic import Metadata
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.messages import Wire, ns_from_ms
from stereovox.sources.bags.tf import Tf, TfPoses
from stereovox.sources.imu import ImuReadings, at_times, in_order, up_of_force

IMU = "sensor_msgs/Imu"
NONE = (np.nan,) * 3
REALSENSE = re.compile(r"/device_\d+/sensor_\d+/(Gyro|Accel)_\d+/imu/data")
"""Topics of librealsense's own recordings, whose axes are the depth image's."""
OPTICAL = "optical"
"""Part of the names of frames with optical axes (REP 103); without /tf they are assumed to match the images' axes."""
MAX_READINGS = 5_000_000
"""For one topic: more than three hours at 400 Hz."""
SAMPLES, MIN_SAMPLES = 300, 10
"""Messages that are read, spread over the recording, and the required minimum."""


class Reading(NamedTuple):
    """A `sensor_msgs/Imu`: time in ns, frame, angular rate in rad/s and specific force in m/s^2, NaN: not measured."""

    stamp_ns: int
    frame_id: str
    rate: tuple[float, ...]
    force: tuple[float, ...]


def read_imu(wire: Wire) -> Reading:
    """Return the readings of a `sensor_msgs/Imu`; raises ValueError if it is too short."""
    stamp_ns, frame_id = wire.header()
    numbers = wire.numbers("d", 4 + 9 + 3 + 9 + 3 + 1)
    rate, force = numbers[13:16], numbers[25:28]
    # a first covariance of -1: not measured
    return Reading(
        stamp_ns, frame_id, *(NONE if of[0] < 0 else of[1] for of in ((numbers[16], rate), (numbers[28], force)))
    )


def read_acceleration(wire: Wire) -> tuple[int, str, NDArray[np.float64]]:
    """Return time in nanoseconds, frame and acceleration (3,) in m/s^2 of a `sensor_msgs/Imu`.

    Raises ValueError if it is too short, not finite, or marked as having no acceleration.
    """
    found = read_imu(wire)
    if not np.isfinite(found.force).all():
        raise ValueError("has no acceleration")
    return found.stamp_ns, found.frame_id, np.array(found.force)


def up_by_gravity(file: BagFile, poses: TfPoses) -> NDArray[np.float64] | None:
    """Return the unit vector (3,) that points up in the world of `poses`.

    None if no IMU's frame is connected with it by /tf, or the mean acceleration is not gravity.
    """
    for topic in sorted(topic for topic, kind in file.types.items() if kind == IMU):
        found = []
        count = len(file.stamps(topic))
        for i in np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).astype(int)).tolist():
            try:
                stamp_ns, frame_id, acceleration = read_acceleration(file.read(topic, i))
                found.append(poses.of(frame_id).at(stamp_ns)[:3, :3] @ acceleration)
            except (FrameRefused, ValueError):
                continue
        if len(found) >= MIN_SAMPLES:
            up = up_of_force(np.mean(found, axis=0))
            if up is not None:
                return up
    return None


class Topic(NamedTuple):
    """All readings of one topic: times (N,) in ns, angular rates and specific forces (N, 3), and the first frame."""

    stamps_ns: NDArray[np.int64]
    rate: NDArray[np.float64]
    force: NDArray[np.float64]
    frame_id: str

    @property
    def turns(self) -> bool:
        """Whether angular rates were measured: RealSense's acceleration topics contain only zeros."""
        return bool(np.nan_to_num(self.rate).any())

    @property
    def feels(self) -> bool:
        """Whether accelerations were measured."""
        return bool(np.nan_to_num(self.force).any())


def read_readings(file: BagFile, tf: Tf | None, frame_id: str, topic: str = "") -> ImuReadings | None:
    """Return the readings of the IMU in a bag; None if it has none.

    If one topic has angular rates and another accelerations (RealSense: gyro and accel), the latter are interpolated to
    the times of the former.

    Args:
        file: The bag.
        tf: Its transforms, for the mount of the IMU.
        frame_id: Frame of the images.
        topic: Topic of the IMU, "" for the only one with angular rates.

    Raises:
        SourceError: There are several IMUs, no such topic, or none with a known mount.
    """
    names = sorted(name for name, kind in file.types.items() if kind == IMU)
    if topic and topic not in names:
        raise SourceError(f"{file.path}: no topic {topic} of {IMU}{did_you_mean(topic, names)}")
    found = {name: _topic(file, name) for name in names}
    turning = [name for name in ([topic] if topic else names) if found[name].turns]
    if len(turning) > 1:
        raise SourceError(f"{file.path}: several IMUs, choose one: ?imu={' or ?imu='.join(turning)}")
    if not turning:
        return None
    gyro = found[turning[0]]
    force = gyro.force
    feeling = [name for name in names if found[name].feels and not found[name].turns]
    if not gyro.feels:
        accel = found[_nearest_name(turning[0], feeling)] if feeling else None
        force = np.full_like(gyro.rate, np.nan) if accel is None else _at(accel, gyro.stamps_ns)
    name = f"{file.path.name} {turning[0]}"
    return in_order(gyro.stamps_ns, gyro.rate, force, _mount(file, tf, frame_id, turning[0], gyro), name)


def _topic(file: BagFile, name: str) -> Topic:
    recorded = file.stamps(name)[:MAX_READINGS]
    count = len(recorded)
    stamps, numbers, frame = np.zeros(count, np.int64), np.full((count, 6), np.nan), ""
    own = Metadata(file, f"{name.removesuffix('data')}metadata") if REALSENSE.fullmatch(name) else None
    for i in range(count):
        try:
            one = read_imu(file.read(name, i))
        except (FrameRefused, ValueError):
            continue  # its angular rate stays NaN, and it is left out
        told = own.at(int(recorded[i])).get("timestamp", "") if own else ""
        stamps[i] = (ns_from_ms(told) if told else None) or one.stamp_ns  # as for images, see `DepthTopic.image`
        numbers[i], frame = (*one.rate, *one.force), frame or one.frame_id
    return Topic(stamps, numbers[:, :3], numbers[:, 3:], frame)


def _nearest_name(name: str, others: list[str]) -> str:
    """Return the topic with the longest common path: the one of the same camera."""
    return max(others, key=lambda other: len(os.path.commonpath([f"/{name}", f"/{other}"])))


def _at(accel: Topic, wanted_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the forces of a topic at other times."""
    known = np.flatnonzero(np.isfinite(accel.force).all(axis=1))
    stamps, first = np.unique(accel.stamps_ns[known], return_index=True)
    return at_times(stamps, accel.force[known[first]], wanted_ns)


def _mount(file: BagFile, tf: Tf | None, frame_id: str, name: str, gyro: Topic) -> Transform:
    """Return T_images_imu (4, 4): from /tf, else the identity if both have optical axes."""
    if tf is not None and frame_id and gyro.frame_id:
        try:
            return tf.lookup(frame_id, gyro.frame_id, int(gyro.stamps_ns[len(gyro.stamps_ns) // 2]))
        except FrameRefused:
            pass
    same = gyro.frame_id != "" and gyro.frame_id == frame_id
    if REALSENSE.fullmatch(name) or same or OPTICAL in gyro.frame_id:
        return np.eye(4)
    said = f"the mount of the IMU of {name} ('{gyro.frame_id}') on the camera ('{frame_id}') is unknown"
    raise SourceError(f"{file.path}: {said}; record /tf_static, or add ?imu=off")
