# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes of CDR: by rosbags, which shares no code with the node."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from stereovox.sources.bags.writer_messages import Messages


@cache
def store() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)


def messages() -> Messages:
    return Messages(store(), 2)


def packed(message: Any) -> bytes:
    return bytes(store().serialize_cdr(message, message.__msgtype__))


def made(kind: str, **fields: Any) -> Any:
    return store().types[kind](**fields)


def header(stamp_ns: int, frame_id: str) -> Any:
    return messages()._header(stamp_ns, frame_id)


def image(pixels: np.ndarray, stamp_ns: int = 5, frame_id: str = "eye", **other: Any) -> bytes:
    message = messages().image(pixels, stamp_ns, frame_id)
    for name, value in other.items():
        setattr(message, name, value)
    return packed(message)


def cloud(points: np.ndarray, stamp_ns: int = 5, frame_id: str = "lidar", names: str = "xyz", **other: Any) -> bytes:
    points = np.asarray(points, np.float32)
    fields = [
        made("sensor_msgs/msg/PointField", name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate(names)
    ]
    given = {"height": 1, "width": len(points), "point_step": 4 * len(names), "row_step": points.nbytes, **other}
    data = np.frombuffer(points.tobytes(), np.uint8)
    return packed(
        made(
            "sensor_msgs/msg/PointCloud2", header=header(stamp_ns, frame_id), fields=fields, is_bigendian=False,
            is_dense=True, data=data, **given,
        )
    )  # fmt: skip
