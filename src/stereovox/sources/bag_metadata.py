# SPDX-License-Identifier: Apache-2.0
"""What stands beside the images and poses of a recording: settings of the sensor, and metadata of every frame."""

from __future__ import annotations

import math

import numpy as np

from stereovox.errors import FrameRefused
from stereovox.sources.bag_files import BagFile
from stereovox.sources.bag_messages import read_pairs, read_value

PAIRS = ("diagnostic_msgs/KeyValue", "std_msgs/String")
VALUES = ("std_msgs/Float32", "std_msgs/String")


class Metadata:
    """Keys and values that were recorded at the very time of a message of another topic; {} where there are none."""

    def __init__(self, file: BagFile, topic: str):
        self._file, self._topic = file, topic
        self._kind = file.types.get(topic, "")
        self._stamps = file.stamps(topic) if self._kind in PAIRS else np.empty(0, np.int64)

    def at(self, recorded_ns: int) -> dict[str, str]:
        """Return what was recorded at that time; what cannot be read is left out."""
        found: dict[str, str] = {}
        first, last = (int(np.searchsorted(self._stamps, recorded_ns, side)) for side in ("left", "right"))
        for i in range(first, last):
            try:
                found.update(read_pairs(self._file.read(self._topic, i), self._kind))
            except (FrameRefused, ValueError):
                continue
        return found


def option(file: BagFile, sensor: str, name: str) -> float | None:
    """Return a setting of a RealSense sensor (`/device_0/sensor_0`), for example "Depth Units"; None where not told.

    Spaces in the name became underscores in librealsense 2.57.
    """
    for written in (name, name.replace(" ", "_")):
        topic = f"{sensor}/option/{written}/value"
        kind = file.types.get(topic, "")
        if kind in VALUES:
            try:
                value = read_value(file.read(topic, 0), kind)
            except (FrameRefused, ValueError):
                continue
            if math.isfinite(value) and value > 0:
                return value
    return None


def sibling(topic: str, name: str) -> str:
    """Return the topic `name` beside `topic`."""
    return f"{topic.rpartition('/')[0]}/{name}"
