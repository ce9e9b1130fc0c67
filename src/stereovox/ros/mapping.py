# SPDX-License-Identifier: Apache-2.0
"""The map of the node: owns the mapper, and replaces it when a map is loaded or reset.

Services of the node: save, load and reset the map.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from collections.abc import Mapping as Table
from functools import partial
from pathlib import Path
from typing import Any

from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.formats.map_server import read_map_server
from stereovox.frame import Frame, Rays, Scan, UpdateReport
from stereovox.frame.stamp_clock import StampsBy
from stereovox.geometry.se3 import Transform
from stereovox.mapper import AnyMapper, GridMapper, Mapper
from stereovox.mapping.rebuild import CorrectionReport, FrameKey
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.record.health import Health
from stereovox.maps.record.history import History
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.maps.storage.storage import EVERYWHERE
from stereovox.products.floor_axes import Heights
from stereovox.products.projection import LiveProjection
from stereovox.ros.library import Background

PosesOf = Callable[[Sequence[KeptFrame]], Table[FrameKey, Transform]]
"""Returns new poses of kept frames (4, 4), by sensor and stamp."""


class Mapping:
    """A 3-D map or a floor map, by the settings, and its 2-D projection.

    heights: metres above the floor that a robot occupies, for the 2-D map of a 3-D map. tiles: folder for cells outside
    the window. notify: called once with a line if a 3-D map shows no floor.

    Attributes:
        mapper: The current mapper; `load` and `reset` replace it.
        corrections: Corrections in progress, in a thread of their own. Replacing the map drops those not begun.
    """

    mapper: AnyMapper[Any]  # the node gives it only frames that its options allow

    def __init__(
        self,
        config: Config,
        heights: Heights | None = None,
        tiles: Path | None = None,
        notify: Callable[[str], None] = lambda line: None,
    ):
        self._heights, self._tiles, self._notify = heights, tiles, notify
        self._stamp_clock: StampsBy = None
        self.corrections: Background[CorrectionReport] = Background("stereovox-corrections")
        self._begin(config)

    @property
    def config(self) -> Config:
        """Settings of the map."""
        return self.mapper.config

    @property
    def history(self) -> History:
        """History of the map's frames."""
        return self.mapper.map.history

    def stamps_by(self, clock: StampsBy) -> None:
        """Set the clock of the frames' stamps, as `Mapper.stamp_clock`, for this mapper and later ones."""
        self._stamp_clock = self.mapper.stamp_clock = clock

    def add(self, frame: Frame | Rays | Scan) -> UpdateReport:
        """Add a frame or scan to the map."""
        return self.mapper.add(frame)

    def correct(self, poses_of: PosesOf, newest_only: bool = False) -> None:
        """Correct the map in the background.

        poses_of: called there with the kept frames, returns new poses by sensor and stamp. newest_only: replace
        corrections that have not begun yet.
        """
        if isinstance(self.mapper, Mapper):
            self.corrections.put(partial(_correct, self.mapper, poses_of), newest_only)

    def health(self) -> Health:
        """Return how current the map is."""
        return self.mapper.health()

    def grid(self, last: bool = False) -> OccupancyGrid | None:
        """Return the 2-D map; None if nothing is known. last: it is the final one (`LiveProjection.grid`)."""
        return self._above(last=last)

    def snapshot(self) -> Callable[[], VoxelMap] | None:
        """Return a function that copies the cells in memory, callable from any thread; None for a floor map."""
        voxel_map = self.mapper.map
        if not isinstance(voxel_map, VoxelMap):
            return None
        with voxel_map.lock:  # a correction may be running
            coords, cells = voxel_map.storage.blocks_within(*EVERYWHERE)

        def copy() -> VoxelMap:
            copied = VoxelMap(voxel_map.config)
            copied.storage.insert(coords, cells)
            return copied

        return copy

    def save(self, path: str) -> None:
        """Save the map atomically; raises MapFileError."""
        self.mapper.save(path)

    def load(self, path: str) -> None:
        """Continue a saved map; raises StereovoxError, and changes nothing, if that is impossible."""
        if self.config.dimensions == 2:
            floor = read_map_server(path)
            if floor.note:
                self._notify(f"{path}: {floor.note}")
            self._begin_floor(load_config(self.config, voxel_size=floor.resolution), floor)
        else:
            saved = load_map(path)
            saved.storage.check_cells(self.config)  # before the current map is closed
            self.close()
            self._begin_space(self.config, saved)

    def reset(self) -> None:
        """Start again with an empty map."""
        self.close()
        self._begin(self.config)

    def close(self) -> None:
        """Release the map's open files, once the correction in progress has ended."""
        self.corrections.drop()
        self.mapper.close()

    def _begin(self, config: Config) -> None:
        (self._begin_floor if config.dimensions == 2 else self._begin_space)(config)

    def _begin_space(self, config: Config, saved: VoxelMap | None = None) -> None:
        mapper = Mapper(config, resume=saved, tiles=self._tiles, stamp_clock=self._stamp_clock)
        self.mapper, self._above = mapper, LiveProjection(mapper.map, self._heights, notify=self._notify).grid

    def _begin_floor(self, config: Config, saved: OccupancyGrid | None = None) -> None:
        mapper = GridMapper(config, resume=saved, stamp_clock=self._stamp_clock)
        self.mapper, self._above = mapper, lambda last=False: _unless_empty(mapper.occupancy())


def _correct(mapper: Mapper, poses_of: PosesOf) -> CorrectionReport:
    kept = mapper.map.kept_frames
    poses = poses_of(kept.frames) if kept is not None and len(kept) else {}
    return mapper.correct(poses) if poses else CorrectionReport()


def _unless_empty(grid: OccupancyGrid) -> OccupancyGrid | None:
    return grid if grid.cells.size else None


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
