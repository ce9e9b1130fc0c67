# SPDX-License-Identifier: Apache-2.0
"""The whole flow: a frame is checked, becomes a depth image, the image becomes evidence, the map takes it in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.depth import prepare
from stereovox.errors import FrameRefused
from stereovox.frame import Frame
from stereovox.integrate import make_integrator
from stereovox.maps import VoxelMap, make_map


@dataclass(frozen=True)
class UpdateReport:
    """What one frame did: time spent, the number of cells whose value changed, and why it was refused, if it was."""

    depth_ms: float = 0.0
    integrate_ms: float = 0.0
    cells: int = 0
    refused: str | None = None
    detail: str = ""


class Mapper:
    """Builds a map from frames. A frame that cannot be trusted is refused and changes nothing.

    Give a profile name, a TOML file or a Config; settings by name on top (`voxel_size=0.1`, `**{"sensor.p_hit": 0.8}`).
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
        self.map = make_map(self.config, resume, tiles)
        self._integrator = make_integrator(self.config)

    def add(self, frame: Frame) -> UpdateReport:
        """Take one frame into the map and tell what it did."""
        start = perf_counter()
        try:
            image = prepare(frame, self.config)
        except FrameRefused as refused:
            self.map.frames_refused += 1
            return UpdateReport(refused=refused.reason, detail=str(refused))
        prepared = perf_counter()
        self.map.look_from(image.viewpoint)
        evidence = self._integrator.evidence(image)
        cells = self.map.add(evidence)
        self.map.frames += 1
        return UpdateReport(1e3 * (prepared - start), 1e3 * (perf_counter() - prepared), cells)
