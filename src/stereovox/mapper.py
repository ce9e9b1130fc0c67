# SPDX-License-Identifier: Apache-2.0
"""The whole flow: a frame becomes a depth image, is checked, becomes evidence, and the map takes it in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import monotonic_ns, perf_counter
from typing import Any

from stereovox.comparing import Comparison
from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame
from stereovox.gate import Passed
from stereovox.guarded import MapLock
from stereovox.health import Health, Watch
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
        self._watch = Watch(self.config, clock)
        self.map = make_map(self.config, resume, tiles)  # it may leave tiles on the disk: what could fail comes before
        self._comparison = Comparison(self.config, self.map.history)
        self._adding = MapLock()

    def add(self, frame: AnyFrame) -> UpdateReport:
        """Take one frame into the map and tell what it did. Several threads may call: frames go in one by one.

        Raises StereovoxError for a thread that holds the map's `lock`.
        """
        arrived = self._watch.now()
        self.map.lock.refuse_holder()
        with self._adding:
            return self._add(frame, arrived)

    def _add(self, frame: AnyFrame, arrived: int) -> UpdateReport:
        start = perf_counter()
        try:
            way = self._pace.way()
            matched = way.depth.matched(frame)
            between = start if matched is frame else perf_counter()
            image = way.depth.image(matched)
            prepared = perf_counter()
            evidence, passed = self._comparison.evidence(frame, image, way.integrator, self.map)
            with self.map.lock:
                self.map.check_room(evidence)
                self.map.look_from(image.viewpoint)
                cells = self.map.add(evidence)
                self.map.history.offered(frame)
                self._remember(passed, way.name, arrived)
        except FrameRefused as refused:
            with self.map.lock:
                self.map.history.offered(frame)
                self.map.history.refuse(refused.reason)
            self._watch.refused(arrived, refused.reason)
            return UpdateReport(refused=refused.reason, detail=str(refused))
        done = perf_counter()
        match_ms, depth_ms, integrate_ms = 1e3 * (between - start), 1e3 * (prepared - between), 1e3 * (done - prepared)
        self._pace.took(match_ms + depth_ms + integrate_ms)
        self._pace.rehearse(frame, matched.camera)
        return UpdateReport(depth_ms, integrate_ms, cells, detail=passed.told, match_ms=match_ms, way=way.name)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: profile '{self.config.profile}'; {self.map!r}>"

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is; `now_ns`: by `clock`, None for now."""
        return self._watch.health(now_ns)

    def _remember(self, passed: Passed, way: str, arrived_ns: int) -> None:
        self.map.history.frames += 1
        self.map.history.ways[way] += 1
        self.map.history.path.walk(passed.sensor, passed.seen)
        self._comparison.took(passed)
        self._watch.took(arrived_ns, passed.sensor, passed.seen.stamp_ns, way)
