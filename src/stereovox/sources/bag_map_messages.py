# SPDX-License-Identifier: Apache-2.0
"""The messages of finished maps, read from their serialised bytes: `nav_msgs/OccupancyGrid`, `octomap_msgs/Octomap`.

ROS 1 and ROS 2 (CDR) alike, as in `bag_messages`. Both raise ValueError, one line, for bytes that do not suffice or say
what cannot be; nothing is allocated for a length that lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, isfinite

import numpy as np

from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.sources.bag_messages import Wire

OCCUPANCY_GRID, OCTOMAP = "nav_msgs/OccupancyGrid", "octomap_msgs/Octomap"


@dataclass(frozen=True)
class OctomapMessage:
    """An `octomap_msgs/Octomap`: nodes as in a `.bt` (binary) or `.ot` file; resolution: side of a cell in metres."""

    frame_id: str
    binary: bool
    tree: str
    resolution: float
    data: bytes


def read_octomap_message(wire: Wire) -> OctomapMessage:
    """Return an `octomap_msgs/Octomap`."""
    _, frame_id = wire.header()
    binary, tree, resolution = bool(wire.number("B")), wire.text(), wire.number("d")
    return OctomapMessage(frame_id, binary, tree, resolution, bytes(wire.data()))


def read_occupancy_grid(wire: Wire) -> OccupancyGrid:
    """Return a `nav_msgs/OccupancyGrid`; numbers that are no per cent are unknown, as navigation programs take them.

    The message's resolution is a float32: the shortest number that means it is taken, 0.05 for 0.0500000007.
    """
    wire.header()
    wire.numbers("I", 2)  # when the map was loaded
    resolution = float(str(np.float32(wire.number("f"))))
    width, height = wire.numbers("I", 2)
    x, y, _, qx, qy, qz, qw = wire.numbers("d", 7)
    count = wire.number()
    if count != width * height or not count:
        raise ValueError(f"a grid of {width} x {height} with {count} cells")
    yaw = atan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    if not (0 < resolution < np.inf and all(map(isfinite, (x, y, yaw)))):
        raise ValueError(f"a grid with cells of {resolution:g} m at {x:g}, {y:g}")
    cells = np.frombuffer(wire.block(count), np.int8)
    known = (cells >= 0) & (cells <= 100)
    return OccupancyGrid(np.where(known, cells, np.int8(UNKNOWN)).reshape(height, width), resolution, (x, y, yaw))
