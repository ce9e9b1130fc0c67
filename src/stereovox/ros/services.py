# SPDX-License-Identifier: Apache-2.0
"""Services of the node: save, load and reset the map."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.ros.mapping import Mapping


def check_continuable(path: str, continuable: bool) -> None:
    """Raise StereovoxError if a map cannot be continued because each run has its own frame."""
    if not continuable:
        raise StereovoxError(f"{path}: a tracked camera, or SLAM, cannot be located in an older map; begin a new one")


class Services:
    """`~/save` and `~/reset` (std_srvs/Trigger), `~/load` (nav_msgs/LoadMap).

    out: returns where to save, "": nowhere. renewed: called after another map has replaced the current one; returns it
    as a `nav_msgs/OccupancyGrid`. continuable: whether saved maps can be continued with the source of poses. Services
    run between two frames.
    """

    def __init__(
        self,
        node: Any,
        mapping: Mapping,
        out: Callable[[], str],
        renewed: Callable[[], Any],
        continuable: bool = True,
    ):
        from nav_msgs.srv import LoadMap
        from std_srvs.srv import Trigger

        self._mapping, self._out, self._renewed, self._log = mapping, out, renewed, node.get_logger()
        self._continuable = continuable
        node.create_service(Trigger, "~/save", self._save)
        node.create_service(Trigger, "~/reset", self._reset)
        node.create_service(LoadMap, "~/load", self._load)

    def _save(self, _: Any, response: Any) -> Any:
        out = self._out()
        try:
            if not out:
                raise StereovoxError("nowhere to save: start with --out MAP, or set the parameter ros.out")
            self._mapping.save(out)
        except StereovoxError as error:
            return self._failed(response, error)
        return self._done(response, f"{self._mapping.history.frames} frames saved in {out}")

    def _reset(self, _: Any, response: Any) -> Any:
        try:
            self._mapping.reset()
        except StereovoxError as error:
            return self._failed(response, error)
        self._renewed()
        return self._done(response, "the map is empty")

    def _load(self, request: Any, response: Any) -> Any:
        path = request.map_url.removeprefix("file://")
        if not os.path.exists(path):  # False for impossible names, for which Path raises
            self._log.error(f"{path}: no such map; check the name")
            response.result = response.RESULT_MAP_DOES_NOT_EXIST
            return response
        try:
            check_continuable(path, self._continuable)
            self._mapping.load(path)
        except StereovoxError as error:
            self._log.error(str(error))
            response.result = response.RESULT_INVALID_MAP_DATA
            return response
        response.map = self._renewed()
        self._log.info(f"continuing {path}")
        response.result = response.RESULT_SUCCESS
        return response

    def _done(self, response: Any, text: str) -> Any:
        self._log.info(text)
        response.success, response.message = True, text
        return response

    def _failed(self, response: Any, error: StereovoxError) -> Any:
        self._log.error(str(error))
        response.success, response.message = False, str(error)
        return response
