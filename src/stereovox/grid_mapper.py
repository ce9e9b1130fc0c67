# SPDX-License-Identifier: Apache-2.0
"""The whole flow on a floor: a scan is checked, becomes evidence on cells, the grid takes it in.

A depth image becomes a scan first.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.depth import DepthPath
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Scan
from stereovox.integrate.beams import make_beams
from stereovox.integrate.scan_check import trusted
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.update_report import UpdateReport


class GridMapper:
    """Builds a floor's map from lidar scans and depth images. What cannot be trusted is refused and changes nothing.

    Poses must be in the map's frame: `Track.corrected` turns those of the odometry into such. Give a profile name, a
    TOML file or a Config; settings by name on top (`voxel_size=0.02`, `**{"grid.update": "every"}`).
    `resume` is a map to go on with, in its own frame. Raises ConfigError for bad settings.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: GridMap | OccupancyGrid | None = None,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._depth = DepthPath(self.config)
        self._beams = make_beams(self.config)
        self.map = self._made(resume)

    def add(self, seen: Scan | AnyFrame) -> UpdateReport:
        """Take one scan or depth image into the map and tell what it did; `depth_ms` is what the scan took."""
        start = perf_counter()
        try:
            scan = trusted(seen if isinstance(seen, Scan) else self._scan_of(seen), self.config)
            between = perf_counter()
            evidence = self._beams.evidence(scan, self.map.origin)
            self.map.check_room(evidence)
        except FrameRefused as refused:
            self.map.frames_refused += 1
            return UpdateReport(refused=refused.reason, detail=str(refused))
        cells = self.map.add(evidence)
        self.map.frames += 1
        done = perf_counter()
        return UpdateReport(1e3 * (between - start), 1e3 * (done - between), cells)

    def occupancy(self) -> OccupancyGrid:
        """Return the map so far as plain numbers, as ROS publishes it."""
        return self.map.occupancy()

    def _scan_of(self, frame: AnyFrame) -> Scan:
        from stereovox.depth.scan import scan_of

        return scan_of(self._depth.image(self._depth.matched(frame)), self.config)

    def _made(self, resume: GridMap | OccupancyGrid | None) -> GridMap:
        if resume is None:
            return GridMap(self.config)
        if isinstance(resume, OccupancyGrid):
            return GridMap.from_occupancy(resume, self.config)
        return resume.with_config(self.config)
