# SPDX-License-Identifier: Apache-2.0
"""The whole flow: a frame becomes a depth image, is checked, becomes evidence, and the map takes it in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import monotonic_ns, perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame
from stereovox.gate import Gate
from stereovox.maps import VoxelMap, make_map
from stereovox.pace import Pace
from stereovox.update_report import UpdateReport as UpdateReport


class Mapper:
    """Builds a map from frames. A frame that cannot be trusted is refused and changes nothing.

    Give a profile name, a TOML file or a Config; settings by name on top (`voxel_size=0.1`,
    `**{"sensor.p_free": 0.3}`).
    `resume` is a map to go on with; what its cells mean must not change. `tiles` is the folder for cells that leave a
    window (`window.outside = "keep"`). `clock`: nanoseconds now. Raises ConfigError for bad settings.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: VoxelMap | None = None,
        tiles: Path | None = None,
        clock: Callable[[], int] = monotonic_ns,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._pace = Pace(self.config)
        self._gate = Gate(self.config, clock)
        self.map = make_map(self.config, resume, tiles)  # last: it may leave tiles on the disk

    def add(self, frame: AnyFrame) -> UpdateReport:
        """Take one frame into the map and tell what it did."""
        start = perf_counter()
        try:
            way = self._pace.way()
            matched = way.depth.matched(frame)
            between = perf_counter()
            image = way.depth.image(matched)
            self._gate.check(frame, image)
            prepared = perf_counter()
            evidence = way.integrator.evidence(image)
            self.map.check_room(evidence)
        except FrameRefused as refused:
            self.map.frames_refused += 1
            self.map.last_frame = frame.name, frame.stamp_ns
            return UpdateReport(refused=refused.reason, detail=str(refused))
        self.map.look_from(image.viewpoint)
        cells = self.map.add(evidence)
        self.map.frames += 1
        self.map.last_frame = frame.name, frame.stamp_ns
        self._gate.took(frame, image)
        done = perf_counter()
        match_ms, depth_ms, integrate_ms = 1e3 * (between - start), 1e3 * (prepared - between), 1e3 * (done - prepared)
        self._pace.took(way, match_ms + depth_ms + integrate_ms)
        return UpdateReport(depth_ms, integrate_ms, cells, match_ms=match_ms, way=way.name)
