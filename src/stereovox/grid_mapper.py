# SPDX-License-Identifier: Apache-2.0
"""The whole flow on a floor: a scan is checked, becomes evidence on cells, the grid takes it in.

A depth image becomes a scan first.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import monotonic_ns, perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.depth import DepthPath
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Scan
from stereovox.gate import Gate
from stereovox.guarded import MapLock
from stereovox.health import FULL, Health, Watch
from stereovox.integrate.beams import make_beams
from stereovox.integrate.scan_check import trusted
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.update_report import UpdateReport


class GridMapper:
    """Builds a floor's map from lidar scans and depth images. What cannot be trusted is refused and changes nothing.

    Poses must be in the map's frame: `Track.corrected` turns those of the odometry into such. Give a profile name, a
    TOML file or a Config; settings by name on top (`voxel_size=0.02`, `**{"grid.update": "every"}`).
    `resume` is a map to go on with, in its own frame. `clock`: nanoseconds now. Raises ConfigError for bad settings.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: GridMap | OccupancyGrid | None = None,
        clock: Callable[[], int] = monotonic_ns,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._depth = DepthPath(self.config)
        self._beams = make_beams(self.config)
        self.map = self._made(resume)
        self._gate = Gate(self.config, self.map.history)
        self._watch = Watch(self.config, clock)
        self._adding = MapLock()

    def add(self, seen: Scan | AnyFrame) -> UpdateReport:
        """Take one scan or depth image into the map and tell what it did; `depth_ms` is what the scan took.

        Several threads may call: scans go in one by one. Raises StereovoxError for one that holds the map's `lock`.
        """
        arrived = self._watch.now()
        self.map.lock.refuse_holder()
        with self._adding:
            return self._add(seen, arrived)

    def _add(self, seen: Scan | AnyFrame, arrived: int) -> UpdateReport:
        start = perf_counter()
        try:
            scan = trusted(seen if isinstance(seen, Scan) else self._scan_of(seen), self.config)
            with self.map.lock:
                passed = self._gate.check(seen, scan)
            between = perf_counter()
            evidence = self._beams.evidence(scan, self.map.origin)
            with self.map.lock:
                self.map.check_room(evidence)
                cells = self.map.add(evidence)
                self.map.history.offered(seen)
                self.map.history.frames += 1
                self._gate.took(passed)
        except FrameRefused as refused:
            with self.map.lock:
                self.map.history.offered(seen)
                self.map.history.refuse(refused.reason)
            self._watch.refused(arrived, refused.reason)
            return UpdateReport(refused=refused.reason, detail=str(refused))
        self._watch.took(arrived, passed.sensor, passed.seen.stamp_ns, FULL)
        done = perf_counter()
        return UpdateReport(1e3 * (between - start), 1e3 * (done - between), cells, detail=passed.told)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: profile '{self.config.profile}'; {self.map!r}>"

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is; `now_ns`: by `clock`, None for now."""
        return self._watch.health(now_ns)

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
