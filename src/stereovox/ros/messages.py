# SPDX-License-Identifier: Apache-2.0
"""From a map to messages of rclpy. Numbers go in as `array.array`: lists are checked one by one."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np

from stereovox.health import Health
from stereovox.maps import VoxelMap
from stereovox.maps.cubes import in_cubes
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.octomap_write import binary_tree, full_tree

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("probability", "<f4")])
FLOAT32 = 7
"""`sensor_msgs/PointField` type."""
LEVELS = {"current": b"\0", "waiting": b"\1", "degraded": b"\1", "lost": b"\2", "stale": b"\3"}
"""Of `diagnostic_msgs/DiagnosticStatus`: OK, WARN, ERROR, STALE."""


def time_of(stamp_ns: int) -> Any:
    """Return a `builtin_interfaces/Time`."""
    from builtin_interfaces.msg import Time

    seconds, rest = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=seconds, nanosec=rest)


def header(stamp_ns: int, frame_id: str) -> Any:
    """Return a `std_msgs/Header`."""
    from std_msgs.msg import Header

    return Header(stamp=time_of(stamp_ns), frame_id=frame_id)


def occupancy_message(grid: OccupancyGrid, stamp_ns: int, frame_id: str) -> Any:
    """Return a `nav_msgs/OccupancyGrid`."""
    from nav_msgs.msg import OccupancyGrid as Message

    message = Message(header=header(stamp_ns, frame_id))
    message.info.map_load_time = message.header.stamp
    message.info.resolution = float(grid.resolution)
    message.info.height, message.info.width = grid.cells.shape
    x, y, yaw = grid.origin
    message.info.origin.position.x, message.info.origin.position.y = float(x), float(y)
    message.info.origin.orientation.z, message.info.origin.orientation.w = np.sin(yaw / 2), np.cos(yaw / 2)
    message.data = array("b", np.ascontiguousarray(grid.cells, np.int8).tobytes())
    return message


def cloud_message(voxel_map: VoxelMap, stamp_ns: int, frame_id: str) -> Any:
    """Return the centres of the occupied cells and their probabilities as a `sensor_msgs/PointCloud2`."""
    from sensor_msgs.msg import PointCloud2, PointField

    centers = voxel_map.occupied()
    points = np.empty(len(centers), POINT)
    points["x"], points["y"], points["z"] = centers.T
    points["probability"] = voxel_map.probability(centers)
    fields = [
        PointField(name=name, offset=4 * n, datatype=FLOAT32, count=1) for n, name in enumerate(POINT.names or ())
    ]
    return PointCloud2(
        header=header(stamp_ns, frame_id), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=POINT.itemsize, row_step=points.nbytes, data=array("B", points.tobytes()), is_dense=True,
    )  # fmt: skip


def octomap_message(voxel_map: VoxelMap, full: bool, stamp_ns: int, frame_id: str) -> Any:
    """Return an `octomap_msgs/Octomap`; full: with log-odds, else only what is occupied and free.

    Raises MapFileError for cells that an octree cannot hold.
    """
    from octomap_msgs.msg import Octomap  # pyright: ignore[reportMissingImports] - it is not on PyPI

    tree = (full_tree if full else binary_tree)(in_cubes(voxel_map))
    return Octomap(
        header=header(stamp_ns, frame_id), binary=not full, id="OcTree", resolution=float(min(voxel_map.config.cell)),
        data=array("b", tree.data),
    )  # fmt: skip


def diagnostics_message(name: str, health: Health, more: Mapping[str, object], now_ns: int) -> Any:
    """Return a `diagnostic_msgs/DiagnosticArray` of one status, with health and `more` as values."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    told = {**health.as_dict(), **more}
    values = [KeyValue(key=key, value=_said(value)) for key, value in told.items() if key not in ("state", "text")]
    status = DiagnosticStatus(
        level=LEVELS[health.state], name=name, message=health.text, hardware_id="stereovox", values=values
    )
    return DiagnosticArray(header=header(now_ns, ""), status=[status])


def _said(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_said(one)}" for key, one in value.items())
    return f"{value:.3f}" if isinstance(value, float) else str(value)
