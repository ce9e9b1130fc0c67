# SPDX-License-Identifier: Apache-2.0
"""Publish the map: the 2-D map with each frame, large messages at a lower rate from a thread of their own.

A stand-in for Nav2's map_server: a floor map on `/map` and on request.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from collections.abc import Mapping as Table
from concurrent.futures import Future, ThreadPoolExecutor
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.formats.octomap import binary_tree, full_tree
from stereovox.maps import VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.record.health import STALE, UNFIT, Health
from stereovox.maps.storage.cubes import in_cubes
from stereovox.ros.library import optional_message
from stereovox.ros.mapping import Mapping
from stereovox.ros.options import Options

FLOAT32 = 7
"""`sensor_msgs/PointField` type."""
LEVELS = {"current": b"\0", "waiting": b"\1", "degraded": b"\1", "lost": b"\2", "stale": b"\3"}
"""Levels of `diagnostic_msgs/DiagnosticStatus`: OK, WARN, ERROR, STALE."""
UNHEARD_S = 1.0
"""Seconds between 2-D maps without a subscriber: a late subscriber gets one at most this old."""
DIAGNOSED_S = 1.0
MAP, CLOUD, BINARY, FULL = "map_mapping", "occupied_cells", "octomap_binary", "octomap_full"
"""Topics; the OctoMap ones have the names of octomap_server."""


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
    message.data = array("b", np.ascontiguousarray(grid.message_cells).tobytes())
    return message


def cloud_message(voxel_map: VoxelMap, stamp_ns: int, frame_id: str) -> Any:
    """Return the centres of the occupied cells and their probabilities as a `sensor_msgs/PointCloud2`."""
    centers = voxel_map.occupied()
    return points_message(centers, stamp_ns, frame_id, probability=voxel_map.probability(centers))


def points_message(xyz: NDArray[np.floating], stamp_ns: int, frame_id: str, **more: NDArray[np.floating]) -> Any:
    """Return points (N, 3) in metres as a `sensor_msgs/PointCloud2` of floats. more: further fields, (N,) each."""
    from sensor_msgs.msg import PointCloud2, PointField

    names = "x", "y", "z", *more
    points = np.empty(len(xyz), [(name, "<f4") for name in names])
    for name, values in zip(names, (*xyz.T, *more.values()), strict=True):
        points[name] = values
    fields = [PointField(name=name, offset=4 * n, datatype=FLOAT32, count=1) for n, name in enumerate(names)]
    return PointCloud2(
        header=header(stamp_ns, frame_id), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=points.itemsize, row_step=points.nbytes, data=array("B", points.tobytes()), is_dense=True,
    )  # fmt: skip


def octomap_message(voxel_map: VoxelMap, full: bool, stamp_ns: int, frame_id: str) -> Any:
    """Return an `octomap_msgs/Octomap`; full: with log-odds, else only occupied and free.

    Raises MapFileError for cells that an octree cannot hold.
    """
    from octomap_msgs.msg import Octomap

    tree = (full_tree if full else binary_tree)(in_cubes(voxel_map))
    return Octomap(
        header=header(stamp_ns, frame_id), binary=not full, id="OcTree", resolution=float(min(voxel_map.config.cell)),
        data=array("b", tree.data),
    )  # fmt: skip


def diagnostics_message(name: str, health: Health, more: Table[str, object], now_ns: int) -> Any:
    """Return a `diagnostic_msgs/DiagnosticArray` of one status, with health and `more` as values."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    figures = {**health.as_dict(), **more}
    values = [
        KeyValue(key=key, value=_format_value(value)) for key, value in figures.items() if key not in ("state", "text")
    ]
    status = DiagnosticStatus(
        level=LEVELS[health.state], name=name, message=health.text, hardware_id="stereovox", values=values
    )
    return DiagnosticArray(header=header(now_ns, ""), status=[status])


def _format_value(value: object) -> str:
    if isinstance(value, Table):
        return ", ".join(f"{key} {_format_value(one)}" for key, one in value.items())
    return f"{value:.3f}" if isinstance(value, float) else str(value)


class Outputs:
    """Publishes a map that frames have changed unless its health forbids it, also after a correction, and at the end.

    Each message has the stamp of the map's newest frame; diagnostics always give its age.

    counts: returns the values of diagnostics besides health. clock: monotonic seconds."""

    def __init__(
        self,
        node: Any,
        mapping: Mapping,
        options: Options,
        counts: Callable[[], Table[str, object]],
        clock: Callable[[], float] = monotonic,
    ):
        self._node, self._mapping, self._options = node, mapping, options
        self._counts, self._clock = counts, clock
        self._publishers = _Publishers(node, mapping.config.dimensions, options)
        self._stamp_ns, self._frame_id = 0, ""
        self._new_map = self._new_cloud = self._corrected = False
        self._next_map = self._next_cloud = self._next_diagnostics = 0.0
        self._worker = ThreadPoolExecutor(1, "stereovox-messages")
        self._busy: Future[None] | None = None

    def changed(self, stamp_ns: int, frame_id: str) -> None:
        """Mark the map as changed by a frame of that time. frame_id: name of the map's frame."""
        self._stamp_ns, self._frame_id = stamp_ns, frame_id
        self._new_map = self._new_cloud = True

    def renewed(self, stamp_ns: int, frame_id: str) -> Any:
        """Publish a map that has replaced another, so that no later subscriber gets the old one; return it in 2-D.

        A map without a known cell is sent as one unknown cell: an empty `nav_msgs/OccupancyGrid` clears nobody's copy.
        """
        self.changed(stamp_ns, frame_id)
        grid = self._grid() or OccupancyGrid(np.full((1, 1), -1, np.int8), self._mapping.config.voxel_size)
        message = occupancy_message(grid, stamp_ns, frame_id)
        self._publishers.map.publish(message)
        copy = self._mapping.snapshot()
        if copy is not None:
            self._busy = self._worker.submit(self._send_cells, copy, stamp_ns, frame_id, to_nobody=True)
        return message

    def corrected(self) -> None:
        """Mark the map as changed by a correction; its newest frame stays the same."""
        self._new_map = self._new_cloud = self._corrected = True

    def update(self) -> None:
        """Publish what is due."""
        now = self._clock()
        new_map = self._new_map and now >= self._next_map
        new_cloud = self._new_cloud and now >= self._next_cloud and self._publishers.has_subscribers() and self._idle()
        if (new_map or new_cloud) and (self._corrected or self._current()):
            if new_map:
                self._publish_map(now)
            if new_cloud:
                self._publish_cells(now)
        if now >= self._next_diagnostics:
            self._next_diagnostics = now + DIAGNOSED_S
            stamp_ns = self._node.get_clock().now().nanoseconds
            name = f"{self._node.get_fully_qualified_name()}: map"
            self._publishers.status.publish(diagnostics_message(name, self._mapping.health(), self._counts(), stamp_ns))

    def close(self) -> None:
        """Publish the final map and wait for messages in progress."""
        if self._new_map:
            self._publish_map(self._clock(), last=True)
        self._worker.shutdown()

    def _current(self) -> bool:
        """Return whether the map is fresh enough to be published, else log why not."""
        health = self._mapping.health()
        if health.state in STALE:
            text = f"the map is not published, since it is {health.text}"
            self._node.get_logger().error(text, throttle_duration_sec=10.0)
        return health.state not in UNFIT

    def _publish_map(self, now: float, last: bool = False) -> None:
        self._new_map = self._corrected = False
        heard = self._publishers.map.get_subscription_count() > 0
        period = 1 / self._options.map_rate if heard else UNHEARD_S
        self._next_map = max(self._next_map, now - period) + period  # one frame may be early: camera rates vary
        grid = self._grid(last)
        if grid is not None:
            self._publishers.map.publish(occupancy_message(grid, self._stamp_ns, self._frame_id))

    def _grid(self, last: bool = False) -> OccupancyGrid | None:
        """Return the 2-D map; None if nothing is known, or, after logging it, if it cannot be made."""
        try:
            return self._mapping.grid(last)
        except StereovoxError as error:
            self._log_error(error)
            return None

    def _publish_cells(self, now: float) -> None:
        self._new_cloud, self._next_cloud = False, now + 1 / self._options.cloud_rate
        copy = self._mapping.snapshot()
        if copy is not None:
            self._busy = self._worker.submit(self._send_cells, copy, self._stamp_ns, self._frame_id)

    def _send_cells(self, copy: Callable[[], VoxelMap], stamp_ns: int, frame_id: str, to_nobody: bool = False) -> None:
        try:
            self._publishers.send(copy(), stamp_ns, frame_id, to_nobody)
        except StereovoxError as error:
            self._log_error(error)

    def _log_error(self, error: StereovoxError) -> None:
        self._node.get_logger().error(f"cannot be published: {error}", throttle_duration_sec=10.0)

    def _idle(self) -> bool:
        if self._busy is None:
            return True
        if self._busy.done():
            self._busy.result()  # raises unforeseen errors of the worker
            return True
        return False


class _Publishers:
    """The publishers of the node."""

    def __init__(self, node: Any, dimensions: int, options: Options):
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import OccupancyGrid
        from sensor_msgs.msg import PointCloud2

        self._full = options.full_octomap
        self.map = node.create_publisher(OccupancyGrid, MAP, latched_qos())
        self.status = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._cloud = self._octomap = None
        if dimensions == 3:
            self._cloud = node.create_publisher(PointCloud2, CLOUD, latched_qos())
            octomap = optional_message("octomap_msgs", "Octomap")
            if octomap is None:
                node.get_logger().info("octomap_msgs is not installed, so no OctoMap is published")
            else:
                self._octomap = node.create_publisher(octomap, FULL if self._full else BINARY, latched_qos())

    def has_subscribers(self) -> bool:
        """Return whether the cloud or the OctoMap has a subscriber."""
        return any(one is not None and one.get_subscription_count() > 0 for one in (self._cloud, self._octomap))

    def send(self, voxel_map: VoxelMap, stamp_ns: int, frame_id: str, to_nobody: bool = False) -> None:
        """Publish the cloud and the OctoMap if they have subscribers; to_nobody: even without, for later ones."""
        if self._cloud is not None and (to_nobody or self._cloud.get_subscription_count()):
            self._cloud.publish(cloud_message(voxel_map, stamp_ns, frame_id))
        if self._octomap is not None and (to_nobody or self._octomap.get_subscription_count()):
            self._octomap.publish(octomap_message(voxel_map, self._full, stamp_ns, frame_id))


def latched_qos() -> Any:
    """Return the quality of service of maps: reliable, with the last one kept for late subscribers."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


MAP_TOPIC, GET_MAP = "map", "map_server/map"
"""Topic and service of Nav2's map_server."""


class MapServer:
    """Publishes a floor map on `/map`, and answers `/map_server/map` (nav_msgs/GetMap) with it.

    frame_id: the map's frame. Until there is a map, the answer is an empty one of 0 x 0 cells.
    """

    def __init__(self, node: Any, frame_id: str):
        from nav_msgs.msg import OccupancyGrid as Message
        from nav_msgs.srv import GetMap

        self._frame_id, self._message = frame_id, Message()
        self._publisher = node.create_publisher(Message, MAP_TOPIC, latched_qos())
        node.create_service(GetMap, GET_MAP, self._answer)

    def show(self, grid: OccupancyGrid, stamp_ns: int) -> None:
        """Publish a map."""
        self._message = occupancy_message(grid, stamp_ns, self._frame_id)
        self._publisher.publish(self._message)

    def _answer(self, _: Any, response: Any) -> Any:
        response.map = self._message
        return response
