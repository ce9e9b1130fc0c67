# SPDX-License-Identifier: Apache-2.0
"""How thoroughly there is time to look at a frame."""

from __future__ import annotations

from stereovox.config import Config
from stereovox.depth import DepthPath
from stereovox.integrate import make_integrator


class Way:
    """One way from a frame to evidence: its settings, what makes depth images, what makes evidence of them."""

    def __init__(self, name: str, config: Config):
        self.name = name
        self.depth = DepthPath(config)
        self.integrator = make_integrator(config)


class Pace:
    """Chooses the way of each frame so that frames take no longer than `deadline_ms`."""

    def __init__(self, config: Config):
        self._full = Way("full", config)

    def way(self) -> Way:
        """Return the way of the next frame. Raises FrameRefused `no_time` where it is to be left out."""
        return self._full

    def took(self, way: Way, milliseconds: float) -> None:
        """Learn from the time that a frame took."""
