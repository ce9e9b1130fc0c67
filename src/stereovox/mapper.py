# SPDX-License-Identifier: Apache-2.0
"""The whole flow: a frame is checked, becomes a depth image, the image becomes evidence, the map takes it in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.depth import DepthPath
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame
from stereovox.integrate import make_integrator
from stereovox.maps import VoxelMap, make_map


@dataclass(frozen=True)
class UpdateReport:
    """What one frame did: milliseconds spent, cells whose value changed, and why it was refused, if it was.

    match_ms: rectify and match a stereo pair; depth_ms: prepare the depth image; integrate_ms: put it into the map.
    """

    depth_ms: float = 0.0
    integrate_ms: float = 0.0
    cells: int = 0
    refused: str | None = None
    detail: str = ""
    match_ms: float = 0.0


class Mapper:
    """Builds a map from frames. A frame that cannot be trusted is refused and changes nothing.

    Give a profile name, a TOML file or a Config; settings by name on top (`voxel_size=0.1`,
    `**{"sensor.p_free": 0.3}`).
    `resume` is a map to go on with; what its cells mean must not change. `tiles` is the folder for cells that leave a
    window (`window.outside = "keep"`). Raises ConfigError for bad settings.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: VoxelMap | None = None,
        tiles: Path | None = None,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._depth = DepthPath(self.config)
        self._integrator = make_integrator(self.config)
        self.map = make_map(self.config, resume, tiles)  # last: it may leave tiles on the disk

    def add(self, frame: AnyFrame) -> UpdateReport:
        """Take one frame into the map and tell what it did."""
        start = perf_counter()
        try:
            matched = self._depth.matched(frame)
            between = perf_counter()
            image = self._depth.image(matched)
        except FrameRefused as refused:
            self.map.frames_refused += 1
            return UpdateReport(refused=refused.reason, detail=str(refused))
        prepared = perf_counter()
        self.map.look_from(image.viewpoint)
        evidence = self._integrator.evidence(image)
        cells = self.map.add(evidence)
        self.map.frames += 1
        done = perf_counter()
        return UpdateReport(
            1e3 * (prepared - between), 1e3 * (done - prepared), cells, match_ms=1e3 * (between - start)
        )
