# SPDX-License-Identifier: Apache-2.0
"""A stand-in for Nav2's map_server: a floor map on `/map` and on request."""

from __future__ import annotations

from typing import Any

from stereovox.maps.occupancy import OccupancyGrid
from stereovox.ros.outputs import latched_qos, occupancy_message

MAP, GET_MAP = "map", "map_server/map"
"""Topic and service of Nav2's map_server."""


class MapServer:
    """Publishes a floor map on `/map`, and answers `/map_server/map` (nav_msgs/GetMap) with it.

    frame_id: the map's frame. Until there is a map, the answer is an empty one of 0 x 0 cells.
    """

    def __init__(self, node: Any, frame_id: str):
        from nav_msgs.msg import OccupancyGrid as Message
        from nav_msgs.srv import GetMap

        self._frame_id, self._message = frame_id, Message()
        self._publisher = node.create_publisher(Message, MAP, latched_qos())
        node.create_service(GetMap, GET_MAP, self._answer)

    def show(self, grid: OccupancyGrid, stamp_ns: int) -> None:
        """Publish a map."""
        self._message = occupancy_message(grid, stamp_ns, self._frame_id)
        self._publisher.publish(self._message)

    def _answer(self, _: Any, response: Any) -> Any:
        response.map = self._message
        return response
